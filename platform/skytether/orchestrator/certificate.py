"""A certificate that is renewed on the disk is used from the next connection on; connections that are open stay."""

from __future__ import annotations

import logging
import ssl
from pathlib import Path

log = logging.getLogger(__name__)

_Signature = tuple[tuple[int, int, int], ...]


class LiveCertificate:
    """Watches the files of a server's certificate. Used from the server's own thread: nobody connects meanwhile."""

    def __init__(self, context: ssl.SSLContext, certificate: Path, key: Path) -> None:
        """``context`` has what is in the files now."""
        self._context = context
        self._files = certificate, key
        self._seen = self._signature()

    def look(self) -> None:
        """Use what is in the files, if they changed and go together; otherwise go on with what was there before."""
        now = self._signature()
        if now == self._seen:
            return
        self._seen = now
        try:
            # Half of a pair may be written: the context that serves gets only what another one takes.
            ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(*self._files, password=_no_password)
            self._context.load_cert_chain(*self._files, password=_no_password)
        except (OSError, ssl.SSLError) as error:
            why = getattr(error, "strerror", None) or str(error)
            log.warning("the new certificate %s cannot be used (%s): the one before is used on", self._files[0], why)
        else:
            log.info("the certificate %s was renewed", self._files[0])

    def _signature(self) -> _Signature | None:
        try:
            found = [path.stat() for path in self._files]
        except OSError:
            return None
        return tuple((one.st_ino, one.st_mtime_ns, one.st_size) for one in found)


def _no_password() -> str:
    """Of a key with a password: nobody is there to be asked for it."""
    return ""
