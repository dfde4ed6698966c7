"""Successors: instances to which a robot changes without a gap.

Make before break: a successor is an instance of its own, for the same robot. The robot learns of it with its next
renewal, brings a second session up, changes when that one commands, and lets the first go. Nothing here touches what
runs, so whatever goes wrong with a successor costs the robot nothing.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace

from skytether.api.rest import Measurement, Report, Size, State

from ..config.settings import Timing, Weights
from ..domain.records import Record, new_record
from ..domain.transitions import displaced, explained, failed, stopped, takes_over
from ..store.store import Store
from .placement import UNSTARTED, explain_refusals
from .placer import Placer
from .site import about_to_end, reachable
from .sites import Sites
from .standbys import Standbys

log = logging.getLogger(__name__)

_BY_ITSELF = ("fallback", "stop")
"""What controls a robot whose service is not good enough for it."""


class Successors:
    """Decides what is moved; called by the one that leads, and by requests."""

    def __init__(
        self,
        store: Store,
        sites: Sites,
        placer: Placer,
        standbys: Standbys,
        clock: Callable[[], float],
        timing: Timing,
        weights: Weights,
    ) -> None:
        """``clock`` gives seconds since the epoch."""
        self._store = store
        self._sites = sites
        self._placer = placer
        self._standbys = standbys
        self._clock = clock
        self._timing = timing
        self._weights = weights
        self._bad_since: dict[str, float] = {}
        """By instance: since when its robot has driven by itself."""

    def successor_of(self, record: Record, site: str | None = None, size: Size | None = None) -> Record:
        """An instance like another one, for the same robot; not stored yet.

        What could not start that one is not tried again, unless it is the ``site`` that was asked for. It is to have
        ``size``, or else what that one has or is about to have.
        """
        wants = size or record.wants
        now = self._clock()
        return new_record(
            robot=record.robot,
            service=record.service,
            manifest=record.manifest,
            params=record.params,
            size=record.size if wants is None else wants.model_dump(),
            measurements=record.measurements,
            created_at=now,
            updated_at=now,
            lease_s=record.lease_s,
            lease_expires_at=now + record.lease_s,
            refused=[refusal for refusal in record.refused if refusal["reason"] == UNSTARTED and site is None],
            replaces=record.id,
            pinned=site,
        )

    def fail_over(self, record: Record, why: str) -> None:
        """Give the robot of an instance that does not serve a standby, if there is one."""
        if record.standby or self._store.successor(record.id) is not None:
            return
        wanted = self.successor_of(record)
        for standby in self._standbys.fitting(replace(wanted, replaces=None, refused=[])):
            now = self._clock()
            if self._store.claim(takes_over(standby, wanted, now), now, "", None, ""):
                log.warning("%s for %s: %s; standby %s takes over", record.service, record.robot, why, standby.id)
                return

    def watch(self, live: Sequence[Record]) -> None:
        """Fail over from sites that do not answer, and move what is about to be ended, or serves its robot badly."""
        now = self._clock()
        for record in live:
            if record.state is not State.RUNNING or record.standby:
                continue
            if not reachable(self._sites.find(record.site)):
                self.fail_over(record, f"site {record.site} does not answer")
            elif why := about_to_end(self._sites.find(record.site), record.id):
                self._evacuate(record, why, now)
            elif record.reason:
                self._store.change(explained(record, ""), now)  # it need not leave any more
        reports = self._store.reports(_BY_ITSELF)
        bad = {r.id for r in live if r.state is State.RUNNING and r.id in reports}
        self._bad_since = {i: self._bad_since.get(i, now) for i in bad}
        for record in live:
            if now - self._bad_since.get(record.id, now) >= self._timing.replace_after:
                self._replace(record, Report.model_validate(reports[record.id]), now)

    def _evacuate(self, record: Record, why: str, now: float) -> None:
        """Move what its site is about to end; it stays where nothing else takes it, and says so."""
        self.fail_over(record, why)
        if self._store.successor(record.id) is not None:
            reason = f"{why}: its robot is handed over"
        else:
            wanted = self.successor_of(record)
            decision = self._placer.weigh(wanted, self._placer.promised([record]))
            if decision.site is not None:
                self._store.add(wanted, "", None, "")
                log.warning(
                    "%s for %s (%s): %s: moving it to %s",
                    *(record.service, record.robot, record.id, why, decision.site),
                )
                reason = f"{why}: its robot is handed over"
            else:
                reason = f"{why}, and nothing else takes it: {explain_refusals(wanted, decision.refused)}"
        if reason != record.reason:
            self._store.change(explained(record, reason), now)

    def displace(self, record: Record, why: str) -> None:
        """Place anew what was lost with its site; ``why`` is a sentence."""
        now = self._clock()
        if record.state is State.STOPPING:
            self._store.change(stopped(record, why), now)
            return
        if record.standby:
            self._store.change(failed(record, why), now)
            return
        self.fail_over(record, why)
        self._store.change(displaced(record, f"{why}: trying another site"), now)

    def move_for_size(self, record: Record, size: Size, why: str) -> tuple[str | None, str]:
        """Start another one of that size where there is room, for one whose site does not give it that.

        Returns:
            Where, or None, and what came of it in words.
        """
        coming = self._store.successor(record.id)
        if coming is not None:
            return None, f"{why}; instance {coming} is to take over already"
        wanted = self.successor_of(record, size=size)
        decision = self._placer.weigh(wanted, self._placer.promised())  # both of them, for a while
        if decision.site is None:
            return None, f"{why}, and nothing else takes it: {explain_refusals(wanted, decision.refused)}"
        self._store.add(wanted, "", None, "")
        return decision.site, f"{why}: its robot is handed over to another one at {decision.site}"

    def _replace(self, record: Record, report: Report, now: float) -> None:
        if 0 <= now - (record.running_at or now) < self._timing.replace_pause or self._store.successor(record.id):
            return
        wanted = self.successor_of(record)
        others = self._placer.promised([record])
        best = next(iter(self._placer.weigh(wanted, others).scores), None)
        rtt_ms = None if report.rtt_s is None else report.rtt_s * 1000
        here = {record.site or "": Measurement(rtt_ms=rtt_ms).model_dump(exclude_none=True)}
        as_it_is = replace(wanted, replaces=None, measurements={**record.measurements, **here})
        scores = self._placer.weigh(as_it_is, others, runs=True).scores
        present = next((s.total_ms for s in scores if s.site == record.site), None)
        # Only for what was measured, and only for a gain: else two bad sites would hand a robot to and fro.
        if best and best.measured and (present is None or best.total_ms + self._weights.migrate_ms < present):
            self._bad_since.pop(record.id, None)
            self._store.add(wanted, "", None, "")
            log.warning(
                "%s for %s (%s) is not good enough at %s: moving it to %s",
                *(record.service, record.robot, record.id, record.site, best.site),
            )

    def clock_was_set(self) -> None:
        """Nothing is known any more of how long things have been as they are."""
        self._bad_since = {}
