"""Secrets: tokens, the operator's token file, and session keys derived from one secret key.

Nothing here logs a secret, and nothing that holds a secret shows it in its ``repr``.
"""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import logging
import os
import secrets
import stat
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.kdf.hkdf import HKDF

TOKEN_MARK = "sky-"  # noqa: S105 (a mark by which scanners can find leaked tokens, no secret)
PREFIX_LENGTH = len(TOKEN_MARK) + 8
_DATABASE = ("state.db", "state.db-wal", "state.db-shm", "state.db-journal")
log = logging.getLogger(__name__)


class SecretFileError(Exception):
    """A file that holds a secret cannot be used; the text says what to do."""


def new_token() -> str:
    """A bearer token of 256 random bits."""
    return TOKEN_MARK + secrets.token_hex(32)


@dataclass(frozen=True)
class TokenHash:
    """What is kept of a token.

    A token is 256 random bits, so nobody can guess candidates to hash, and a plain SHA-256 is as good as a slow
    password hash, at a thousandth of the cost per request.
    """

    prefix: str
    """The first characters, to look the row up by; the remaining 224 bits stay secret."""
    digest: str
    """SHA-256 of the whole token, hexadecimal."""

    @classmethod
    def of(cls, token: str) -> TokenHash:
        return cls(token[:PREFIX_LENGTH], hashlib.sha256(token.encode()).hexdigest())

    def matches(self, token: str) -> bool:
        """Compare in constant time."""
        return hmac.compare_digest(self.digest, hashlib.sha256(token.encode()).hexdigest())


def close_folder(folder: Path, *, with_database: bool) -> None:
    """Make a folder that others cannot look into, or close one that is there, with the database in it.

    Raises:
        SecretFileError: It cannot be closed; the text says what to do.
    """
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        for path, mode in ((folder, 0o700), *((folder / name, 0o600) for name in _DATABASE)):
            if path.exists() and stat.S_IMODE(path.stat().st_mode) & 0o077:
                path.chmod(mode)
                log.warning("others could read %s: it has mode %o now", path, mode)
        if with_database:  # SQLite makes a file as the process's umask says; empty, it is a new database
            os.close(os.open(folder / _DATABASE[0], os.O_CREAT | os.O_RDWR, 0o600))
    except OSError as error:
        raise SecretFileError(
            f"the state folder {folder} cannot be closed to others ({error.strerror}): chmod 700 it, with an owner "
            f"who is to run the orchestrator, or give a folder within it: --state-dir {folder / 'state'}"
        ) from error


def secret_file(path: Path, make: Callable[[], bytes]) -> bytes:
    """Read a secret, or make it at the first start (mode 0600, complete or not there at all).

    Raises:
        SecretFileError: Others may read the file, it is empty, or it can be neither read nor made.
    """
    try:
        return _secret_file(path, make)
    except OSError as error:
        raise SecretFileError(f"cannot read or make {path}: {error.strerror}") from error


def _secret_file(path: Path, make: Callable[[], bytes]) -> bytes:
    if not path.exists():
        draft = path.with_name(f"{path.name}.{secrets.token_hex(4)}")
        with open(os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
            file.write(make())
            file.flush()
            os.fsync(file.fileno())
        with contextlib.suppress(FileExistsError):
            os.link(draft, path)
        draft.unlink()
    if path.is_file() and stat.S_IMODE(path.stat().st_mode) & 0o077:
        raise SecretFileError(f"{path} can be read by others: chmod 600 {path}")
    content = path.read_bytes()
    if not content.strip():
        raise SecretFileError(f"{path} is empty: delete it, and a new one is made at the next start")
    return content


class Secrets:
    """The two secrets of an orchestrator."""

    def __init__(self, folder: Path) -> None:
        """Read or make ``operator.token`` and ``secret.key``.

        Raises:
            SecretFileError: One of them cannot be used.
        """
        self._key = secret_file(folder / "secret.key", lambda: secrets.token_bytes(32))
        token = secret_file(folder / "operator.token", lambda: f"{new_token()}\n".encode())
        try:
            self._operator = TokenHash.of(token.decode("ascii").strip())
        except UnicodeDecodeError as error:
            path = folder / "operator.token"
            raise SecretFileError(
                f"{path} holds no token: delete it, and a new one is made at the next start"
            ) from error

    def is_operator(self, token: str) -> bool:
        return self._operator.matches(token)

    @property
    def fingerprint(self) -> str:
        """By which orchestrators tell whether they have the same secret key; it tells nothing of the key."""
        info = b"skytether fingerprint"
        return HKDF(algorithm=SHA256(), length=16, salt=None, info=info).derive(self._key).hex()

    def session_key(self, session_id: str) -> bytes:
        """32 bytes; always the same for the same session, so that no database needs to hold them."""
        info = b"skytether session " + session_id.encode()
        return HKDF(algorithm=SHA256(), length=32, salt=None, info=info).derive(self._key)
