"""When leases run out, and that none does while robots could not renew: the time by which the passes act.

A clock that was set, a database that was away, an orchestrator that had no room: after each of them all leases count
anew, for nobody can say who would have renewed.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable

from ..domain.clock_jump import ClockJump
from ..domain.overload import Overload
from ..domain.records import Record
from ..domain.transitions import stopping
from ..store.engine import GONE
from ..store.leader import ALONE, Lead, LeadLostError, fence, fenced
from ..store.store import Store

log = logging.getLogger(__name__)

_UNSETTLED = 2.0
"""Seconds after the clock was set in which another orchestrator may still date leases by what it was before."""


class Leases:
    """Shared by all passes; safe from any thread."""

    def __init__(
        self,
        store: Store,
        clock: Callable[[], float],
        retry_s: float,
        forget: Callable[[], object],
        lead: Lead = ALONE,
        steady: Callable[[], float] = time.monotonic,
        overload: Overload | None = None,
    ) -> None:
        """Whose leases, and by which clocks.

        Args:
            store: Where records are.
            clock: Seconds since the epoch.
            retry_s: After which a step is tried again for which the database, or the lead, was lost.
            forget: Called when the clock was set: nothing is known any more of how long things have been as they are.
            lead: Whether this orchestrator acts.
            steady: Seconds of a clock that nobody sets.
            overload: While this is felt no lease runs out.
        """
        self._store = store
        self._clock = clock
        self._retry_s = retry_s
        self._forget = forget
        self._lead = lead
        self._steady = steady
        self._overload = overload or Overload(steady)
        self._lock = threading.Lock()
        self._clock_jump = ClockJump(clock(), steady())
        self.times_set = 0
        """How often the clock was set: what was read before the last time is dated by another one."""
        self._settles_at = -math.inf
        """Steady seconds: leases that others dated until then count anew, and none runs out before."""
        self._database_gone = False
        self._elections = 0
        """Of the lead, for which leases have counted anew: nobody may have led before, and nobody could renew."""

    def guarded(self, step: Callable[[], float]) -> float:
        """Wait where the database does not answer; once it does, leases count anew: nobody could renew meanwhile."""
        try:
            with fenced(self._lead.epoch):
                if self._database_gone and self.leads():
                    self._store.extend_leases(self._clock())
                    log.warning("the database answers again")
                delay = step()
            self._database_gone = False
            return delay
        except LeadLostError as error:
            log.warning("%s", error)
            return self._retry_s
        except GONE as error:
            if not self._database_gone:
                log.error(
                    "the database does not answer, trying again: %s",
                    str(getattr(error, "orig", None) or error).splitlines()[0],
                )
            self._database_gone = True
            return self._retry_s

    def leads(self) -> bool:
        """Whether this pass acts: it may have begun before this orchestrator led, or for an earlier lead of its own."""
        return self._lead.leads and self._lead.epoch == fence()

    def now(self) -> float:
        """The time. Was the clock set, all leases count anew first: nobody can say how old they are."""
        with self._lock:
            now, steady = self._clock(), self._steady()
            by = self._clock_jump.set_by(now, steady)
            if by:
                if self.leads():
                    self._store.extend_leases(now)
                self._forget()
                self.times_set += 1
                self._settles_at = steady + _UNSETTLED
                text = "the clock was set %s by %.0f s, or this machine slept: leases and waits count anew"
                log.warning(text, "forward" if by > 0 else "back", abs(by))
            if -math.inf < self._settles_at <= steady:
                self._settles_at = -math.inf
                if self.leads():
                    self._store.extend_leases(now)  # what is about to end has another version then
            elections = self._lead.elections
            if elections != self._elections and self.leads():
                self._elections = elections  # it may be elected again meanwhile
                self._store.extend_leases(now)
                self.times_set += 1
            if self._overload.owed() and self.leads():
                self._store.extend_leases(now)
                self.times_set += 1
                log.warning("robots could not renew for a while, for want of room or of time: leases count anew")
            self._clock_jump.accept(now, steady)
            return now

    def expire(self, record: Record) -> None:
        """End what its robot has not renewed for too long."""
        if self._overload.felt() or self._steady() < self._settles_at:
            return  # its robot may have been refused, or wait for its answer; or it was dated by another clock
        now = self._clock()
        reason = f"the robot did not renew its lease of {record.lease_s:g} s"
        if self._store.change(stopping(record, now, reason), now):
            log.info("%s for %s (%s): %s", record.service, record.robot, record.id, reason)
