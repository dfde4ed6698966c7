"""Leases and waits are dated by a wall clock: one for all orchestrators over a database, and noticed when it is set."""

from __future__ import annotations

import logging
from collections.abc import Callable

log = logging.getLogger(__name__)

_SET = 1.0
"""Seconds: a clock that is off by more since the last look was set, or its machine slept; slewing stays below."""


class ClockJump:
    """Tells by how much the wall clock was set."""

    def __init__(self, wall: float, steady: float) -> None:
        """``wall``: seconds since the epoch; ``steady``: monotonic seconds of the same moment."""
        self._offset = wall - steady

    def set_by(self, wall: float, steady: float) -> float:
        """Seconds by which it was set since ``accept``, forward positive; 0: it was not."""
        by = wall - steady - self._offset
        return by if abs(by) > _SET else 0.0

    def accept(self, wall: float, steady: float) -> None:
        """From now on this is right."""
        self._offset = wall - steady


class SharedClock:
    """The clock of the database's server, carried on between two looks at it by one that nobody sets.

    Several orchestrators date the leases of the same robots: by their own clocks, one that is an hour ahead would end
    what the others have just renewed.
    """

    def __init__(self, asked: Callable[[], float], steady: Callable[[], float], own: Callable[[], float]) -> None:
        """Take this machine's time until the first look.

        Args:
            asked: Asks the database [s since the epoch].
            steady: Seconds of a clock that nobody sets and that goes on while the machine sleeps.
            own: This machine's time [s since the epoch], only to be compared.
        """
        self._asked = asked
        self._steady = steady
        self._own = own
        self._offset = own() - steady()
        self._told = ClockJump(0.0, 0.0)

    def __call__(self) -> float:
        """Seconds since the epoch."""
        return self._steady() + self._offset

    def sync(self) -> None:
        """Ask the database; raises what its driver raises.

        What it says was true at some moment between question and answer: the offset stays if it can be so.
        """
        before = self._steady()
        said = self._asked()
        after = self._steady()
        self._offset = min(max(self._offset, said - after), said - before)
        ahead = self._own() - self()
        if self._told.set_by(ahead, 0.0):
            self._told.accept(ahead, 0.0)
            if abs(ahead) > _SET:
                where = "ahead of" if ahead > 0 else "behind"
                log.warning("this machine's clock is %.0f s %s the database's, which counts", abs(ahead), where)
            else:
                log.info("this machine's clock agrees with the database's again")
