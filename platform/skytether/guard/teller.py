"""Telling the wheels, and writing down what they were told. Guard, writer and gate do it in the same way.

Only one of them does so at a time, and each starts from what the wheels were really told last, by whomever
(`board.Board`). The guard, or on a graph the writer, is the first and speaks whenever it can; the gate is the second
and speaks while the first is silent. Who takes over *claims* the wheels on the board before it speaks, and waits until
the other one has either seen that or cannot speak any more:

- The second claims when the first gave no sign for `SILENT` periods, and speaks in a later turn if there still is none.
- The first, once the second may speak (`LATE` periods after its claim), claims too and waits for a period, in which
  the second sees the claim and gives way. Sooner than that it simply speaks: the second sees it in time.
- Nobody speaks by a look at the board that is older than `LATE` periods: after a freeze in between it looks again.
- Where another process sends what is written, and stands still or fails, the wheels were told what had left before
  that, and whoever is next goes on from there. What goes on from something leaves while the wheels turn by what is
  known to have left, or never: after that they stand.
- Where the kernel keeps what was sent until it is acknowledged, and sends it again, a first that stood still with
  something of that is ended by the second that has taken over (`board.Place.keep`).
- Each has its own connections. Where somebody listens to one who takes over, or goes on after it stood still, whom the
  other one's words did not reach, or who came lately, all hear a standstill of that one first.
- Where velocities go by other threads or processes, one that stands still between its last look at the clock and the
  kernel is ended by who takes over (`board.Place.end_speaker`).

Whoever turns the wheels may be held up, and read later what waits for it. Once no more can be sent to it, nobody knows
whether they turn: it is told what goes on from the last velocity, or, when that was too long ago, nothing until it has
read all and the wheels stand by themselves. A word between them and a standstill would be a jump for one of the two.
Only a stop is not kept waiting.

Where whoever turns the wheels acknowledges what they are told, and does not any more, they are braked: perhaps they
hear it, and if they do not, the first word that reaches them again finds them as they are, at a standstill.
"""

from __future__ import annotations

import errno
from collections import deque
from collections.abc import Callable
from math import inf, isnan, nan
from typing import NamedTuple, Protocol

from .board import Board, Entry, Role, end, mark
from .protocol import LastCommand
from .velocity import STANDSTILL, Velocity
from .watch import Watch

SILENT = 1.5
"""Periods. The gate speaks in every period, and the first answers it by telling the wheels."""
LATE = 0.75
"""Periods."""
FRESH = 1.5
"""Periods. No older is what somebody else sends for who tells the wheels something when the other one may speak."""
SPEAKS = 0.4
"""Periods. Who says something for longer stands still; less than `LATE`."""
_SOON = 0.5
"""Periods. So much later than the second's claim the first may still speak without a claim of its own."""
_UNREAD = "their driver does not read what it is sent"
_ENDED = "process {} stood still as it told the wheels something, and was ended: it would go on with what is old by now"
_KEPT = "process {} stood still, and was ended: what it told the wheels last was not acknowledged, and would come later"
_KEPT_S, _MOST_KEPT_S = 0.06, 0.15
"""Later than Linux puts off an acknowledgement, and sooner than it sends anything again (0.04 and 0.2 s)."""
_LATER = 2
"""Periods. So much longer than by their own patience the wheels are left to stop: nobody saw the very moment."""
_WRITTEN = 256
"""Velocities that are remembered: of the time within which it is seen that who sends them stands still."""
_CONNECTS_S = 8.0
"""For who listens to one of both to listen to the other one, too: TCP tries after 1, 3 and 7 s."""
_AGAIN_S = 1.0
"""Between attempts on a way that is broken; meanwhile the other one speaks."""


def repeat_s(period_s: float, patience_s: float) -> float:
    """Time [s] after which the first says the same again, if nothing new is wanted.

    Not sooner than it must: what comes a little late, a period even, then finds that all the time since the last change
    still counts for the next one, and braking gets no weaker.
    """
    return min(max(patience_s - 3 * period_s, 1.25 * period_s), 2 * period_s)


class Sent(NamedTuple):
    """How far what was written has come, where another process sends it."""

    left_at: float
    """When the last was written that is known to have left [s]."""
    heard_at: float
    """The same, and to have been acknowledged where those who turn the wheels do that [s]."""
    lost: bool = False
    """What was written after it never does."""
    stuck: bool = False
    """Who sends it stands still: nothing can be written now."""
    unheard: bool = False
    """Of those who turn the wheels somebody is not known to hear yet."""


class Wheels(Protocol):
    """Where velocities go."""

    def write(self, velocity: Velocity, until: float = inf) -> None:
        """What the wheels do until the next call. Returns at once.

        Args:
            velocity: Of the robot.
            until: If it has not left by then, it never does [s].

        Raises:
            BlockingIOError: What was sent before waits to be read, and there is no room for more.
            OSError: There is nobody whom anybody could tell anything.
            Exception: This way to them is broken.
        """
        ...

    def full(self) -> bool:
        """Whether there is no room for more, as what was sent before waits to be read."""
        ...

    def unread(self) -> str:
        """Who does not acknowledge what is written, for longer than they may, in words; empty: all do, or none can."""
        ...

    def listeners(self) -> frozenset[str] | None:
        """Who listens to the velocities now, each under a name that is another after it was away; None: not known."""
        ...

    def hearers(self) -> frozenset[str]:
        """Who listened at the last look, each under a name that both who tell the wheels know it by."""
        ...

    def sent(self) -> Sent | None:
        """How far what was written has come; None: what was written has left."""
        ...


class Teller:
    """One who tells the wheels.

    Args:
        wheels: The way to them.
        watch: What they are told.
        board: What they were told.
        role: Of this one.
        period_s: Of its loop [s].
        clock: `clock.now`; replaced by tests only.
    """

    def __init__(
        self, wheels: Wheels, watch: Watch, board: Board, role: Role, period_s: float, clock: Callable[[], float]
    ) -> None:
        self._wheels = wheels
        self._watch = watch
        self._board = board
        self._role = role
        self._period_s = period_s
        self._clock = clock
        self._listeners: frozenset[str] | None = frozenset()
        self._strangers_at = -inf
        """When others came in the place of all who had listened, or the first ones did [s]."""
        self._spoke_at = -inf
        """When this one last told the wheels something, and not just had them counted as standing [s]."""
        self._names, self._hearers = frozenset[str](), frozenset[int]()
        """Who listens, and as the board knows them."""
        self._sent: Sent | None = None
        self._written: deque[LastCommand] = deque(maxlen=_WRITTEN)
        """The newest last."""
        self.unread = ""
        """What is wrong with those who were told something last: they do not acknowledge it; empty: nothing."""
        self.ended = ""
        """Whether a process was ended at the last attempt, in words; empty: none was."""
        self._follows = False
        """Whether something of the other one may be on its way still."""
        usual_s = watch.patience_s - 2 * period_s  # what an acknowledgement may take
        self._kept_s = min(max(_KEPT_S, usual_s), _MOST_KEPT_S)
        self._broken_at = nan
        self._full_at = nan
        self._own, self._claim, self._left_at, self._reached = board.of(role)  # of who had the role before
        self._heard_at = board.newest().left_at
        """As `board.Entry.left_at`, of whoever told the wheels something last."""

    def refresh(self, now: float) -> None:
        """See what the wheels were told, and who listens; once in each turn, whether they are told anything or not.

        Args:
            now: [s]
        """
        before, self._sent = self._sent, self._wheels.sent()
        self._see_left(self._clock())  # it may have come while this process stood still
        newest = self._board.newest()
        if (self._sent and self._sent.lost) or (before and before.lost):
            self._watch.told = newest.told  # what was learned may have been taken back
        else:
            self._watch.learn(newest.told)
        self._heard_at = self._left_at if newest.told == self._own else newest.left_at
        if self._is_stuck():
            return
        known, self._listeners = self._listeners, self._wheels.listeners()
        if self._listeners and not (known and known & self._listeners):
            self._strangers_at = now
        if (names := self._wheels.hearers()) != self._names:
            self._names, self._hearers = names, frozenset(map(mark, names))

    def write_velocity(self, now: float, stopped: bool = False) -> bool:
        """Tell the wheels once what the watch has for them. `refresh` comes before.

        Args:
            now: [s]
            stopped: Brake, whatever is wanted.

        Returns:
            Whether they were. If not: nobody listens, or it is not this one's turn; it soon will be, if the other one
            is silent.

        Raises:
            BlockingIOError: Who turns the wheels does not read. It counts as silence.
            OSError: There is nobody whom anybody could tell anything. It counts as a standstill.
            Exception: This way to them is broken. It counts as silence.
        """
        self.ended = ""
        unheard = self._is_stuck() or (self._listeners is not None and not self._listeners)
        if unheard or 0 <= now - self._broken_at < _AGAIN_S or not self._may(now):
            return False
        spoke_at = min(self._own.at, self._spoke_at)  # what was written may have been lost since
        tells_them = spoke_at >= self._strangers_at and now - spoke_at <= self._watch.patience_s
        if not tells_them and (now - self._strangers_at < _CONNECTS_S or self._misses_some()):
            self._failed(now)  # perhaps the other one did not reach them: they know nothing, or have stopped
        if not stopped and self._waits(now):
            return False
        self.unread = self._wheels.unread()
        missed = self._sent is not None and self._sent.unheard  # a standstill would be missed, and not what follows
        velocity, _ = self._watch.want(now, stopped or missed or bool(self.unread))
        self._end_other(now)
        at, goes_on = self._clock(), self._watch.goes_on(now) and self._watch.told.velocity != STANDSTILL
        until = at + FRESH * self._period_s  # from this look on: this process may stand still at any moment
        if goes_on:
            until = min(until, self._heard_at + self._watch.patience_s)
        if at - now > LATE * self._period_s or at > until or not self._may(at):
            return False
        try:
            self._wheels.write(velocity, until)
        except BlockingIOError:
            self._full_at = at
            raise BlockingIOError(errno.EAGAIN, _UNREAD) from None
        except OSError:
            self._failed(now)
            raise
        except Exception:
            self._broken_at = now
            raise
        self._watch.wrote(velocity, now)
        self._reached, self._spoke_at = self._hearers, now
        self._written.append(self._watch.told)
        self._left_at = self._heard_at if self._sent else now
        self._put(self._watch.told)
        return True

    def _misses_some(self) -> bool:
        """Whether the other one told the wheels something last, and somebody did not listen to it who does to this one.

        Their connection to it may be broken, or still on its way.
        """
        other = self._board.of(_OTHER[self._role])
        return not (isnan(other.told.at) or other.told.at <= self._own.at) and not self._hearers <= other.hearers

    def _end_other(self, now: float) -> None:
        """Whose place this one takes, or has taken, and who stands still with a word that would come later."""
        other = _OTHER[self._role]
        place, spoke = self._board.place(other), self._board.of(other).told.at
        if not (isnan(spoke) or spoke < self._own.at):  # this one takes over
            pid = place.end_speaker(SPEAKS * self._period_s)
            self.ended = _ENDED.format(pid) if pid else ""
            self._follows = self._role is Role.SECOND  # its own last words are few, and brake
        if self._follows and now - spoke > self._kept_s:
            self._follows = False
            if (pid := place.keeper()) and end(pid):
                self.ended = _KEPT.format(pid)

    def _waits(self, now: float) -> bool:
        """Whether the wheels may still turn by what they read late, and what is told now begins at a standstill.

        Raises:
            BlockingIOError: They have not read it yet.
        """
        if isnan(self._full_at):
            return False
        full = self._wheels.full()
        if full:
            self._full_at = now
        if self._watch.goes_on(now):
            return False
        if not 0 <= now - self._full_at <= self._watch.patience_s + _LATER * self._period_s:
            self._full_at = nan
            return False
        self._put(self._own, now)  # a sign, for the other one knows less
        if full:
            raise BlockingIOError(errno.EAGAIN, _UNREAD)
        return True

    def _may(self, at: float) -> bool:
        """Whether this one may speak now; it claims what it needs for that."""
        return self._first_may(at) if self._role is Role.FIRST else self._second_may(at)

    def _first_may(self, at: float) -> bool:
        other = self._board.of(Role.SECOND).claim
        if isnan(other) or at < other + _SOON * self._period_s:
            return True
        if not self._claim > other:
            self._put(self._own, at)
        return at >= self._claim + self._period_s

    def _second_may(self, at: float) -> bool:
        sign = self._board.of(Role.FIRST).sign
        if at - sign <= SILENT * self._period_s:
            if not isnan(self._claim):
                self._put(self._own, nan)
            return False
        if isnan(self._claim) or sign > self._claim:
            self._put(self._own, at)
        return at >= self._claim + LATE * self._period_s

    def _is_stuck(self) -> bool:
        return self._sent is not None and self._sent.stuck

    def _see_left(self, now: float) -> None:
        """What was written after what left, the wheels may not have been told; or never are: it is too old by then."""
        sent = self._sent
        if sent is None:
            return
        heard_at = min(sent.heard_at, self._own.at)
        if self._in_time(heard_at, now):
            self._left_at = max(self._left_at, heard_at)
        if not sent.lost:
            return
        while self._written and self._written[-1].at > sent.left_at:
            self._written.pop()
        if self._own.at > sent.left_at:
            told = self._written[-1] if self._written else LastCommand()
            self._left_at = min(self._left_at, told.at)
            self._put(told)

    def _in_time(self, heard_at: float, now: float) -> bool:
        """Whether the wheels still turned by what they had heard before, as they heard what was written then.

        A network may deliver late what goes on from before, and so may a connection that sends it again. What was
        written later than the wheels' patience allows to go on began at a standstill.
        """
        latest = self._heard_at + self._watch.patience_s
        return now <= latest or (heard_at > latest and now - heard_at <= self._watch.patience_s)

    def _failed(self, now: float) -> None:
        self._watch.failed(now)
        self._left_at = self._heard_at = now
        self._put(self._watch.told)

    def _put(self, told: LastCommand, claim: float | None = None) -> None:
        self._own, self._claim = told, self._claim if claim is None else claim
        self._board.put(self._role, Entry(self._own, self._claim, self._left_at, self._reached))


_OTHER = {Role.FIRST: Role.SECOND, Role.SECOND: Role.FIRST}
