"""Secrets that change while everything runs: sessions keep the key that they began with until they end."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

from ..domain.security import (
    KEY,
    OLD_KEY,
    OPERATOR,
    SecretFileError,
    Secrets,
    fingerprint_of,
    new_key,
    new_operator,
    replace_secret,
)
from ..store.store import Store

log = logging.getLogger(__name__)

FACT = "secret.key"
"""On which all orchestrators over one database agree, by its fingerprint."""
_SETTLED_S = 60.0
PERIOD_S = 2.0
"""Between two looks at the files."""


def rotate_key(folder: Path) -> Path:
    """Another ``secret.key``; the old one stays beside it for the sessions that began with it. Where that is.

    Raises:
        SecretFileError: There is none, or the folder cannot be written.
    """
    path = folder / KEY
    try:
        old = path.read_bytes()
        kept = folder / f"{OLD_KEY}{fingerprint_of(old)}"
        replace_secret(kept, old)
        replace_secret(path, new_key())
    except OSError as error:
        raise SecretFileError(f"cannot change {path}: {error.strerror}; give the orchestrator's folder") from error
    return kept


def rotate_operator(folder: Path) -> Path:
    """Another ``operator.token``; the old one is worth nothing within seconds. Where it is.

    Raises:
        SecretFileError: There is none, or the folder cannot be written.
    """
    path = folder / OPERATOR
    try:
        path.stat()
        replace_secret(path, new_operator())
    except OSError as error:
        raise SecretFileError(f"cannot change {path}: {error.strerror}; give the orchestrator's folder") from error
    return path


class Rotation:
    """Follows what becomes of the files."""

    def __init__(self, folder: Path, secrets: Secrets, store: Store, clock: Callable[[], float]) -> None:
        """``clock`` gives seconds since the epoch, as files have them."""
        self._clock = clock
        self._folder = folder
        self._secrets = secrets
        self._store = store
        self._told = ""

    def agree(self) -> bool:
        """Whether the other orchestrators over this database have the same key, or one that this was before."""
        return self._store.agree(FACT, self._secrets.fingerprint(), self._secrets.old_fingerprints())

    def refresh(self) -> float:
        """Use what is new in the files, and forget keys that no session has any more; seconds until the next look."""
        try:
            if self._secrets.reload():
                log.info("the secrets in %s were changed, and are used from now on", self._folder)
            self._told = ""
        except SecretFileError as error:
            if str(error) != self._told:
                self._told = str(error)
                log.error("%s; those before are used on", error)
            return PERIOD_S
        old = self._secrets.old_fingerprints()
        if old and self.agree():
            self._forget(old)
        return PERIOD_S

    def _forget(self, old: tuple[str, ...]) -> None:
        used = self._store.keys_in_use()
        for number, fingerprint in enumerate(old):
            file = self._folder / f"{OLD_KEY}{fingerprint}"
            if fingerprint in used or (number == 0 and "" in used) or not self._is_settled(file):
                continue
            file.unlink(missing_ok=True)
            log.info("the secret key %s is forgotten: no session has it any more", fingerprint)

    def _is_settled(self, file: Path) -> bool:
        """Whether all orchestrators have seen the rotation by now, and begin no session with this key."""
        try:
            return self._clock() - file.stat().st_mtime > _SETTLED_S
        except OSError:
            return False
