"""Which of several orchestrators over one database acts: the one that has the lead, which it has to renew.

A row of the database says who leads, until when by the database's own clock, and in which epoch: each leader's is
higher than those before. All others answer requests, and wait. A leader that hangs, is frozen or cut off from the
database is replaced when its time is over. It may believe for a moment longer that it leads, or go on in the middle of
something when it is thawed. So nothing depends on what it believes: each change that a leader makes is refused if its
epoch is over (`fenced`), and so is each act at a site that can tell (`Runtime.lead`).

SQLite: a lock on a file beside the database, freed by the kernel when its holder ends, and the row for the epoch alone.
One that hangs keeps it: a second orchestrator over one file is there for the end of the first only.
"""

from __future__ import annotations

import contextlib
import fcntl
import logging
import secrets
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from pathlib import Path
from typing import IO, Protocol

from sqlalchemy import Connection, Engine, select, text

from skytether.guard.clock import now as boottime

from ..domain.rate_limit import RateLimiter
from .engine import GONE
from .models import leadership

log = logging.getLogger(__name__)

LEASE = 2.0
"""Seconds that the lead lasts without being renewed: so long, and a look, is the gap after a leader that vanished."""
_LOOK = 0.4
"""Seconds between two looks, of who leads and of who waits."""
LEAD_PATIENCE_S = 2 * LEASE
"""Seconds without an answer from the database after which whoever leads, or waits to, connects anew. Where all packets
were lost for a while, TCP repeats what was lost after pauses that double: the old connection is the last to hear that
the way is open again. Less, and a way that loses a third never gets a connection to stand."""
_BELIEVED = LEASE - _LOOK
"""Seconds after a renewal was sent for which its sender takes itself for the leader: less than it is."""

# An epoch is no less than the time it begins at: it grows also where the database was restored from an old backup. A
# lead that would last for longer than any lasts is over: the database's clock was set back. Who finds another epoch
# than its own beside its name leads in a new one: the database was restored from when it led before.
_NOW = "extract(epoch FROM clock_timestamp())"
# Where a site has heard of an epoch that is still to come, the database's clock was set back: a new one is above that.
_TAKE = text(
    f"UPDATE leadership SET holder = :me, until = {_NOW} + :lease,"  # noqa: S608 (nothing of it comes from outside)
    " epoch = CASE WHEN holder = :me AND epoch = :mine THEN epoch"
    f" ELSE greatest(epoch + 1, :mine + 1, floor({_NOW})::bigint) END"
    f" WHERE holder = :me OR NOT until BETWEEN {_NOW} AND {_NOW} + :lease RETURNING epoch"
)
_GIVE_UP = text("UPDATE leadership SET until = 0 WHERE holder = :me")
_TAKE_FILE = text(
    "UPDATE leadership SET holder = :me,"
    " epoch = max(epoch + 1, :above + 1, CAST(strftime('%s', 'now') AS INTEGER))"
    " WHERE holder <> :me OR epoch <= :above RETURNING epoch"
)
_HIGHEST = 1 << 62
"""An epoch that no leader had; the database has room for twice as much."""
_RISES_PER_S, _RISES = 1 / 600, 5
"""Epochs that begin because of what sites say, and at once: with each all sites are looked at and all leases count
anew, and a site may be somebody else's machine, which lies."""
_EPOCH_NOW = select(leadership.c.epoch)
_epoch: ContextVar[int] = ContextVar("epoch", default=0)


class LeadLostError(Exception):
    """What is to be changed would be changed for a leader that leads no more."""


@contextlib.contextmanager
def fenced(epoch: int) -> Iterator[None]:
    """All that is changed within, by this thread, is changed as the leader of an epoch; 0: by anybody."""
    before = _epoch.set(epoch)
    try:
        yield
    finally:
        _epoch.reset(before)


def fence() -> int:
    """As whose leader this thread changes something; 0: as nobody's."""
    return _epoch.get()


def check_fence(connection: Connection) -> None:
    """To be called in each transaction that changes something.

    No lock is taken that a frozen leader would hold: a change that is under way when another one takes the lead is one
    made just before, for whoever leads then reads after it, and changes what it has seen only (`Store.change`).

    Raises:
        LeadLostError: This thread acts for a leader that leads no more.
    """
    epoch = fence()
    if epoch and connection.scalar(_EPOCH_NOW) != epoch:
        raise LeadLostError(f"another orchestrator leads: what the leader of epoch {epoch} was about to do is left")


class Lead(Protocol):
    """Whether this orchestrator acts."""

    @property
    def leads(self) -> bool:
        """Whether it does now."""
        ...

    @property
    def epoch(self) -> int:
        """As whose leader; 0: there can be no other one, or it does not lead."""
        ...

    @property
    def elections(self) -> int:
        """How often it began to lead, or could not renew in time and leads on: nobody may have led before."""
        ...

    def rise_above(self, epoch: int) -> None:
        """Lead on, if it leads, in an epoch after this one, of which a site has heard."""


class _Alone:
    leads, epoch, elections = True, 0, 0

    def rise_above(self, epoch: int) -> None:
        """There is no epoch."""


ALONE: Lead = _Alone()
"""Of one that leads because nobody else could."""


class Lock(Protocol):
    """Held by one orchestrator at most."""

    def hold(self, above: int = 0) -> int:
        """Take it, or keep it; gives the epoch. 0: another one has it, or the database does not answer.

        ``above``: the epoch is to be a later one than this; one that is not ends, and another begins.
        """

    def release(self) -> None:
        """Let go; may be called without having it."""


class PostgresLock:
    """The row of the database, by a connection of its own."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine.execution_options(isolation_level="AUTOCOMMIT")
        self._connection: Connection | None = None
        self._me = {"me": secrets.token_hex(8)}
        self._mine = 0
        """The epoch in which it had the lead last."""

    def hold(self, above: int = 0) -> int:
        for _ in range(2):  # somebody may have ended the connection alone
            try:
                if self._connection is None:
                    self._connection = self._engine.connect()
                asked = self._me | {"lease": LEASE, "mine": max(self._mine, above)}
                self._mine = self._connection.scalar(_TAKE, asked) or 0
                return self._mine
            except GONE:
                self._drop()
        return 0

    def release(self) -> None:
        if self._connection is not None:
            with contextlib.suppress(*GONE):
                self._connection.execute(_GIVE_UP, self._me)
            self._drop()

    def _drop(self) -> None:
        connection, self._connection = self._connection, None
        if connection is not None:
            with contextlib.suppress(*GONE):
                connection.invalidate()
                connection.close()


class FileLock:
    """A lock on a file; a database in memory has none, and needs none."""

    def __init__(self, path: Path | None, engine: Engine) -> None:
        self._path = path
        self._engine = engine.execution_options(immediate=True)
        self._file: IO[str] | None = None
        self._me = {"me": secrets.token_hex(8)}
        self._held = 0

    def hold(self, above: int = 0) -> int:
        if self._held > above:
            return self._held
        if self._path is not None and self._file is None:
            file = self._path.open("a")
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                file.close()
                return 0
            self._file = file
        with contextlib.suppress(*GONE):
            with self._engine.begin() as connection:
                epoch = connection.scalar(_TAKE_FILE, self._me | {"above": above}) or 0
            self._held = epoch
        return self._held

    def release(self) -> None:
        file, self._file, self._held = self._file, None, 0
        self._me = {"me": secrets.token_hex(8)}  # who takes it again leads in another epoch
        if file is not None:
            file.close()


def lock_of(engine: Engine) -> Lock:
    """The lock that belongs to a database."""
    if engine.dialect.name == "postgresql":
        return PostgresLock(engine)
    name = engine.url.database
    return FileLock(Path(f"{name}.leader") if name and name != ":memory:" else None, engine)


_NOT_HELD = 0, -1.0


class Leadership:
    """Whether this orchestrator acts. ``step`` is called again and again by a loop of its own."""

    def __init__(self, lock: Lock, steady: Callable[[], float] = boottime) -> None:
        """Not leading yet.

        Args:
            lock: What the leader has.
            steady: Seconds of a clock that nobody sets and that goes on while the machine sleeps.
        """
        self._lock = lock
        self._steady = steady
        self._rises = RateLimiter(_RISES_PER_S, _RISES, steady)
        self._held = _NOT_HELD
        """Epoch, and until when it takes itself for the leader; both at once, for other threads read them."""
        self._above = 0
        self.elections = 0
        """See ``Lead``; counted before it leads."""

    @property
    def leads(self) -> bool:
        """Whether it acts; what it then does is fenced all the same."""
        return self._steady() < self._held[1]

    @property
    def epoch(self) -> int:
        """As whose leader; 0: it does not lead."""
        epoch, until = self._held
        return epoch if self._steady() < until else 0

    def rise_above(self, epoch: int) -> None:
        """See ``Lead``; from any thread. What cannot be a leader's is left as it is."""
        if self._above < epoch < _HIGHEST and not self._rises.wait("all"):
            log.warning("a site has heard of epoch %d, which cannot be yet: the next one is above it", epoch)
            self._above = epoch

    def step(self) -> float:
        """Take the lead, or renew it; returns seconds until the next look."""
        sent, led, before = self._steady(), self.leads, self._held[0]
        epoch = self._lock.hold(self._above)
        if not epoch:
            if before:
                log.warning("this orchestrator leads no more: another one does, or the database does not answer")
            self._held = _NOT_HELD
            return _LOOK
        if epoch != before or not led:
            self.elections += 1
        if epoch != before:
            log.info("this orchestrator leads: it places, starts and stops instances (epoch %d)", epoch)
        self._held = epoch, sent + _BELIEVED
        return _LOOK

    def end(self) -> None:
        """Let another one lead."""
        self._held = _NOT_HELD
        self._lock.release()
