"""Which of several orchestrators over one database acts: the one that holds a lock that ends with its holder.

PostgreSQL: an advisory lock of a connection of its own, so the server frees it when that connection ends, whatever
ended it, and no clocks need to agree. SQLite: a lock on a file beside the database, freed by the kernel. All others
answer requests, and wait. One that lost its connection and does not know yet does no harm: whatever it would do begins
with a change in the database, and that change is lost with the connection.
"""

from __future__ import annotations

import contextlib
import fcntl
import logging
from collections.abc import Callable
from pathlib import Path
from typing import IO, Protocol

from sqlalchemy import Connection, Engine, text

from .db import GONE, LEADING

log = logging.getLogger(__name__)

_LOOK = 1.0
"""Seconds between two looks: so long, and the server's time to notice a dead peer, is the gap without a leader."""


class Lock(Protocol):
    """Held by one orchestrator at most."""

    def hold(self) -> bool:
        """Take it, or see that it is still held; False: another one has it, or the database does not answer."""

    def release(self) -> None:
        """Let go; may be called without having it."""


class PostgresLock:
    """An advisory lock of the database."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine.execution_options(isolation_level="AUTOCOMMIT")
        self._connection: Connection | None = None

    def hold(self) -> bool:
        try:
            if self._connection is not None:
                self._connection.execute(text("SELECT 1"))
                return True
            connection = self._engine.connect()
            if connection.scalar(text(f"SELECT pg_try_advisory_lock({LEADING})")):
                self._connection = connection
                return True
            connection.close()
        except GONE:
            self.release()
        return False

    def release(self) -> None:
        connection, self._connection = self._connection, None
        if connection is not None:
            with contextlib.suppress(*GONE):
                connection.invalidate()  # ends it: back in the pool it would go on holding the lock
                connection.close()


class FileLock:
    """A lock on a file; a database in memory has none, and needs none."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._file: IO[str] | None = None

    def hold(self) -> bool:
        if self._path is None or self._file is not None:
            return True
        file = self._path.open("a")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.close()
            return False
        self._file = file
        return True

    def release(self) -> None:
        file, self._file = self._file, None
        if file is not None:
            file.close()


def lock_of(engine: Engine) -> Lock:
    """The lock that belongs to a database."""
    if engine.dialect.name == "postgresql":
        return PostgresLock(engine)
    name = engine.url.database
    return FileLock(Path(f"{name}.leader") if name and name != ":memory:" else None)


class Leadership:
    """Whether this orchestrator acts. ``step`` is called again and again by a loop of its own."""

    def __init__(self, lock: Lock, on_elected: Callable[[], None]) -> None:
        """``on_elected`` is called, in the loop's thread, before this one begins to lead."""
        self._lock = lock
        self._on_elected = on_elected
        self.leads = False

    def step(self) -> float:
        """Take the lock, or see whether it is still held; returns seconds until the next look."""
        held = self._lock.hold()
        if held and not self.leads:
            self._on_elected()
            log.info("this orchestrator leads: it places, starts and stops instances")
        elif self.leads and not held:
            log.warning("this orchestrator leads no more: another one does, or the database does not answer")
        self.leads = held
        return _LOOK

    def end(self) -> None:
        """Let another one lead."""
        self.leads = False
        self._lock.release()
