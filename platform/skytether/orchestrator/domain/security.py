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
from functools import lru_cache
from pathlib import Path

from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.kdf.hkdf import HKDF

TOKEN_MARK = "sky-"  # noqa: S105 (a mark by which scanners can find leaked tokens, no secret)
PREFIX_LENGTH = len(TOKEN_MARK) + 8
KEY, OPERATOR = "secret.key", "operator.token"
METRICS = "metrics.token"
"""Of who may read measurements; nobody has to have it, and it is never made here."""
OLD_KEY = "secret.key.old-"
"""Before the fingerprint, in the name of a file with a key that sessions still use."""
_SHORTEST = 16
"""Bytes of a secret."""
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
        SecretFileError: It cannot be closed, or is another user's; the text says what to do.
    """
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        _refuse_anothers(folder)
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


def _refuse_anothers(folder: Path) -> None:
    """Where everybody may make folders, somebody may have made this one to have what is put into it."""
    owner, above = folder.stat().st_uid, folder.resolve().parent.stat().st_mode
    if owner not in (0, os.geteuid()) and above & stat.S_IWOTH:
        raise SecretFileError(
            f"{folder} belongs to the user {owner}, who may have made it to be taken for another: name a folder where "
            "not everybody may make some"
        )


def replace_secret(path: Path, content: bytes) -> None:
    """Put a secret into a file, mode 0600, complete or not at all, whatever is there; on the disk when it returns."""
    draft = path.with_name(f"draft-{path.name}.{secrets.token_hex(4)}")
    _write(draft, content)
    draft.replace(path)
    _keep_names(path.parent)


def _write(path: Path, content: bytes) -> None:
    with open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def _keep_names(folder: Path) -> None:
    """Put the names in a folder on the disk: a file that is there under no name is gone with the power."""
    file = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(file)
    finally:
        os.close(file)


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
        draft = path.with_name(f"draft-{path.name}.{secrets.token_hex(4)}")
        _write(draft, make())
        with contextlib.suppress(FileExistsError):
            os.link(draft, path)
        draft.unlink()
        _keep_names(path.parent)
    found = path.stat()
    if stat.S_ISREG(found.st_mode) and stat.S_IMODE(found.st_mode) & 0o077:
        raise SecretFileError(f"{path} can be read by others: chmod 600 {path}")
    ours = {0, os.geteuid(), path.parent.stat().st_uid}
    if found.st_uid not in ours:  # that user may have put it there, and knows it
        raise SecretFileError(
            f"{path} belongs to the user {found.st_uid}: chown it, or delete it if nobody put it there"
        )
    content = path.read_bytes()
    if not content.strip():
        raise SecretFileError(f"{path} is empty: delete it, and a new one is made at the next start")
    return content


@dataclass(frozen=True, repr=False)
class _Held:
    """What is in the files; taken over as one, for other threads use it meanwhile."""

    current: bytes
    old: tuple[bytes, ...]
    """Of sessions that began before the last rotation, the oldest first."""
    operator: TokenHash
    metrics: TokenHash | None


class Secrets:
    """The secrets of an orchestrator, as they are in their files now. Safe from any thread."""

    def __init__(self, folder: Path) -> None:
        """Read or make ``operator.token`` and ``secret.key``.

        Raises:
            SecretFileError: One of them cannot be used, or anybody may put another one in its place.
        """
        _make_folder(folder)
        self._folder = folder
        secret_file(folder / KEY, new_key)
        secret_file(folder / OPERATOR, new_operator)
        self._seen = self._signature()
        self._held = self._read()

    def reload(self) -> bool:
        """Whether a secret is used from now on that was not before; one that is gone is used no more.

        Raises:
            SecretFileError: One of them cannot be used; what was used before still is, until they are mended.
        """
        seen = self._signature()
        if seen == self._seen:
            return False
        before, held = self._held, self._read()
        self._seen, self._held = seen, held  # only now: files that could not be used are looked at again
        put_back = set(held.old) - set(before.old)
        tokens = (held.operator, held.metrics) != (before.operator, before.metrics)
        return held.current != before.current or tokens or bool(put_back)

    def _read(self) -> _Held:
        current = _kept_secret(self._folder / KEY)  # first: a rotation keeps the old one before it puts the new one
        try:
            old = sorted(self._folder.glob(f"{OLD_KEY}*"), key=lambda path: path.stat().st_mtime_ns)
        except OSError as error:
            raise SecretFileError(f"cannot read {self._folder}: {error.strerror}") from error
        keys = tuple(key for key in map(_kept_secret, old) if key != current)
        metrics = self._folder / METRICS
        return _Held(current, keys, _token(self._folder / OPERATOR), _token(metrics) if metrics.exists() else None)

    def _signature(self) -> tuple[tuple[str, int, int, int], ...]:
        named = [self._folder / name for name in (KEY, OPERATOR, METRICS)]
        files = [*named, *sorted(self._folder.glob(f"{OLD_KEY}*"))]
        found = []
        for path in files:
            with contextlib.suppress(OSError):
                now = path.stat()
                found.append((path.name, now.st_ino, now.st_mtime_ns, now.st_ctime_ns))  # the last: of chmod too
        return tuple(found)

    def is_operator(self, token: str) -> bool:
        return self._held.operator.matches(token)

    def may_measure(self, token: str) -> bool:
        """Whether it is the one in ``metrics.token``."""
        return self._held.metrics is not None and self._held.metrics.matches(token)

    def fingerprint(self) -> str:
        """By which orchestrators tell whether they have the same secret key; it tells nothing of the key."""
        return fingerprint_of(self._held.current)

    def old_fingerprints(self) -> tuple[str, ...]:
        """Of the keys before, the oldest first."""
        return tuple(map(fingerprint_of, self._held.old))

    def session_key(self, session_id: str, of: str = "") -> bytes:
        """32 bytes; always the same for the same session, so that no database needs to hold them.

        Args:
            session_id: The session's.
            of: Fingerprint of the secret key that it began with; empty: the oldest, from before they were noted.

        Raises:
            SecretFileError: That key is not here.
        """
        key = self._key(of)
        if key is None:  # another orchestrator was quicker to see a rotation
            self.reload()
            key = self._key(of)
        if key is None:
            raise SecretFileError(f"the secret key {of} that session {session_id} began with is not in {self._folder}")
        info = b"skytether session " + session_id.encode()
        return HKDF(algorithm=SHA256(), length=32, salt=None, info=info).derive(key)

    def _key(self, of: str) -> bytes | None:
        held = self._held
        keys = [*held.old, held.current]
        return next((key for key in keys if fingerprint_of(key) == of), None) if of else keys[0]


def _make_folder(folder: Path) -> None:
    """Make a folder for secrets that others cannot look into; one that is there others must not write to."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        _refuse_anothers(folder)
        mode = folder.stat().st_mode
    except OSError as error:
        raise SecretFileError(f"cannot make the folder {folder} for secrets: {error.strerror}") from error
    if mode & stat.S_IWOTH and not mode & stat.S_ISVTX:
        raise SecretFileError(f"others may put secrets of their own into {folder}: chmod o-w {folder}")


def _kept_secret(path: Path) -> bytes:
    def missing() -> bytes:
        raise SecretFileError(f"{path} is gone: put it back, all keys of sessions are derived from it")

    content = secret_file(path, missing)
    if len(content) < _SHORTEST:  # a copy that was cut off; keys derived from it could be found by trying
        raise SecretFileError(f"{path} has {len(content)} bytes, too few for a secret: put all of it back")
    return content


def _token(path: Path) -> TokenHash:
    try:
        return TokenHash.of(_kept_secret(path).decode("ascii").strip())
    except UnicodeDecodeError as error:
        made = ", and a new one is made at the next start" if path.name == OPERATOR else ""
        raise SecretFileError(f"{path} holds no token: delete it{made}") from error


@lru_cache(maxsize=16)
def fingerprint_of(key: bytes) -> str:
    """Of a secret key."""
    return HKDF(algorithm=SHA256(), length=16, salt=None, info=b"skytether fingerprint").derive(key).hex()


def new_key() -> bytes:
    """What ``secret.key`` holds."""
    return secrets.token_bytes(32)


def new_operator() -> bytes:
    """What ``operator.token`` holds."""
    return f"{new_token()}\n".encode()
