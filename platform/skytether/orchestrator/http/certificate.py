"""A certificate that is renewed on the disk is used from the next connection on; connections that are open stay."""

from __future__ import annotations

import logging
import ssl
import stat
from pathlib import Path

from ..domain.security import SecretFileError

log = logging.getLogger(__name__)

_Signature = tuple[tuple[int, int, int, int], ...]


class LiveCertificate:
    """Watches the files of a server's certificate. Used from the server's own thread: nobody connects meanwhile."""

    def __init__(self, certificate: Path, key: Path) -> None:
        """Read what is in the files now.

        Raises:
            SecretFileError: They cannot be used; the text is a sentence.
        """
        self._files = certificate, key
        self._seen = self._signature()
        self.context = self._read()
        """For connections from now on. Another one after each renewal: OpenSSL keeps a certificate for each kind of key
        in one, so an old one of another kind would be served on."""

    def reload(self) -> None:
        """Use what is in the files, if they changed and go together; otherwise go on with what was there before."""
        now = self._signature()
        if now == self._seen:
            return
        self._seen = now
        try:
            self.context = self._read()
        except SecretFileError as error:
            log.warning("%s: the one before is used on", error)
        else:
            log.info("the certificate %s was renewed", self._files[0])

    def _read(self) -> ssl.SSLContext:
        certificate, key = self._files
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        try:
            for path in self._files:
                if not stat.S_ISREG(path.stat().st_mode):  # a pipe would hold up everybody
                    raise _cannot(certificate, key, f"{path} is no file")
            if stat.S_IMODE(key.stat().st_mode) & 0o007:
                raise _cannot(certificate, key, f"others can read the key: chmod 600 {key}")
            context.load_cert_chain(certificate, key, password=_no_password)
        except (OSError, ssl.SSLError) as error:
            raise _cannot(certificate, key, getattr(error, "strerror", None) or str(error)) from error
        return context

    def _signature(self) -> _Signature | None:
        try:
            found = [path.stat() for path in self._files]
        except OSError:
            return None
        # The last is the time of a chmod too.
        return tuple((one.st_ino, one.st_mtime_ns, one.st_size, one.st_ctime_ns) for one in found)


def _cannot(certificate: Path, key: Path, why: str) -> SecretFileError:
    return SecretFileError(f"the certificate {certificate} with the key {key} cannot be used ({why})")


def _no_password() -> str:
    """Of a key with a password: nobody is there to be asked for it."""
    return ""
