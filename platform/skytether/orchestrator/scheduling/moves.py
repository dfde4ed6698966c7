"""Instances beside instances: successors, to which a robot changes without a gap, and spares, which wait for a robot.

Make before break: a successor is an instance of its own, for the same robot. The robot learns of it with its next
renewal, brings a second session up, changes when that one commands, and lets the first go. Nothing here touches what
runs, so whatever goes wrong with a successor costs the robot nothing.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any, Protocol

from skytether.api.manifest import Manifest
from skytether.api.rest import Measurement, Refusal, Report, Size, State

from ..config.settings import Timing, Weights
from ..domain.errors import InvalidError
from ..domain.records import Record, new_record
from ..domain.validation import check_params
from ..store.store import Store
from .catalog import Catalog
from .placement import UNSTARTED, Decision
from .promises import Sums
from .sites import Sites

log = logging.getLogger(__name__)

FOREVER = 2.5e11
"""End of a spare's lease: a date that can be written (the year 9892)."""
_BY_ITSELF = ("fallback", "stop")
"""What controls a robot whose service is not good enough for it."""
_SETTLED = 30.0
"""Seconds that a spare with other parameters is kept: robots that ask for different ones must not wear it out."""


class Weigh(Protocol):
    """Where a record would run, beside what is promised; ``runs``: it need not be started, which not all sites can."""

    def __call__(self, record: Record, promised: Sums, runs: bool = False) -> Decision: ...


class Promised(Protocol):
    """What sites have promised to all instances, or to all but some."""

    def __call__(self, without: Iterable[Record] = ()) -> Sums: ...


class Moves:
    """Decides what is moved and what is kept warm; called by the one that leads, and by requests."""

    def __init__(
        self,
        store: Store,
        catalog: Catalog,
        sites: Callable[[], Sites],
        weigh: Weigh,
        promised: Promised,
        clock: Callable[[], float],
        timing: Timing,
        weights: Weights,
    ) -> None:
        """``clock`` gives seconds since the epoch."""
        self._store = store
        self._catalog = catalog
        self._sites = sites
        self._weigh = weigh
        self._promised = promised
        self._clock = clock
        self._timing = timing
        self._weights = weights
        self._not_before: dict[str, float] = {}
        """By service: no spare before this, because the last one failed."""
        self.warms = True
        """Whether any service has standbys, or is to have some, as of the last look."""
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

    def spares_for(self, record: Record) -> list[Record]:
        """Warm instances that could be this one, the best site's first; none at a site that is much worse."""
        same = [spare for spare in self._store.spares(record.service) if _alike(spare, record)]
        if not same:
            return []
        others = self._promised(same)
        scores = {score.site: score.total_ms for score in self._weigh(record, others, runs=True).scores}
        cold = (score.total_ms for score in self._weigh(record, others).scores)
        limit = min(cold, default=math.inf) + self._weights.migrate_ms
        here = [s for s in same if self._reachable(s) and not self._leaving(s)]
        good = [s for s in here if s.site in scores and scores[s.site] <= limit]
        return sorted(good, key=lambda spare: (scores[spare.site or ""], spare.created_at))

    def keep_spares(self) -> None:
        """Start the spares that are missing, and end those that nobody would get."""
        now = self._clock()
        kept: dict[str, int] = {}
        catalog = {manifest.metadata.name: manifest for manifest in self._catalog.all()}
        spares = self._store.live_spares()
        self.warms = bool(spares) or any(manifest.spec.needs.standby for manifest in catalog.values())
        for spare in spares:
            if spare.state is State.STOPPING:
                continue
            manifest = catalog.get(spare.service)
            wanted = manifest.spec.needs.standby if manifest else 0
            current = manifest is not None and _document(manifest) == spare.manifest
            if current and (self._stale(spare, now) or self._drains(spare) or self._leaving(spare)):
                current = False
            if current and kept.get(spare.service, 0) < wanted:
                kept[spare.service] = kept.get(spare.service, 0) + 1
            else:
                self._end(spare, now)
        for name, manifest in catalog.items():
            if kept.get(name, 0) < manifest.spec.needs.standby and now >= self._not_before.get(name, 0.0):
                self._add_spare(manifest, now)

    def _stale(self, spare: Record, now: float) -> bool:
        """It has other parameters than the last request, and has had its time."""
        params = self._store.last_params(spare.service)
        return params is not None and params != spare.params and abs(now - spare.created_at) > _SETTLED

    def _add_spare(self, manifest: Manifest, now: float) -> None:
        name = manifest.metadata.name
        params = self._store.last_params(name) or {}
        try:
            check_params(params, manifest.spec.params, name)
        except InvalidError:
            return  # parameters are needed, and nobody has asked yet
        spare = new_record(
            robot="",
            service=name,
            manifest=_document(manifest),
            params=params,
            created_at=now,
            updated_at=now,
            lease_s=self._timing.spare_lease,
            lease_expires_at=FOREVER,
            spare=True,
        )
        if self._weigh(spare, self._promised()).site is not None:  # robots come first: a spare does not wait for room
            self._store.add(spare, "", None, "")

    def _end(self, spare: Record, now: float) -> None:
        to = State.STOPPED if spare.site is None else State.STOPPING
        self._store.change(spare, now, state=to, stopping_at=now, reason="this standby is not needed any more")

    def spare_failed(self, record: Record) -> None:
        """Do not try another one at once."""
        self._not_before[record.service] = self._clock() + self._timing.backoff_max

    def clock_was_set(self) -> None:
        """Nothing is known any more of how long things have been as they are."""
        self._not_before, self._bad_since = {}, {}

    def fail_over(self, record: Record, why: str) -> None:
        """Give the robot of an instance that does not serve a spare, if there is one."""
        if record.spare or self._store.successor(record.id) is not None:
            return
        wanted = self.successor_of(record)
        for spare in self.spares_for(replace(wanted, replaces=None, refused=[])):
            robot: dict[str, Any] = {"robot": record.robot, "measurements": record.measurements, "replaces": record.id}
            if wanted.has != spare.has:
                as_before = {"reason": "successor", "why": f"instance {record.id} had that"}
                robot["resize"] = {**wanted.has.model_dump(), **as_before}
            lease = {"lease_s": record.lease_s, "lease_expires_at": wanted.lease_expires_at}
            now = self._clock()
            if self._store.claim(spare, {**robot, **lease, "created_at": now}, now, "", None, ""):
                log.warning("%s for %s: %s; standby %s takes over", record.service, record.robot, why, spare.id)
                return

    def watch(self, live: Sequence[Record]) -> None:
        """Fail over from sites that do not answer, and move what is about to be ended, or serves its robot badly."""
        now = self._clock()
        for record in live:
            if record.state is not State.RUNNING or record.spare:
                continue
            if not self._reachable(record):
                self.fail_over(record, f"site {record.site} does not answer")
            elif why := self._leaving(record):
                self._evacuate(record, why, now)
            elif record.reason:
                self._store.change(record, now, reason="")  # it need not leave any more
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
            decision = self._weigh(wanted, self._promised([record]))
            if decision.site is not None:
                self._store.add(wanted, "", None, "")
                log.warning(
                    "%s for %s (%s): %s: moving it to %s",
                    *(record.service, record.robot, record.id, why, decision.site),
                )
                reason = f"{why}: its robot is handed over"
            else:
                reason = f"{why}, and nothing else takes it: {told(wanted, decision.refused)}"
        if reason != record.reason:
            self._store.change(record, now, reason=reason)

    def displace(self, record: Record, why: str) -> None:
        """Place anew what was lost with its site; ``why`` is a sentence."""
        now = self._clock()
        if record.state is State.STOPPING:
            self._store.change(record, now, state=State.STOPPED, reason=why)
            return
        if record.spare:
            self._store.change(record, now, state=State.FAILED, reason=why)
            return
        self.fail_over(record, why)
        self._store.change(
            record,
            now,
            through=State.STARTING if record.state is State.RUNNING else None,
            state=State.PENDING,
            reason=f"{why}: trying another site",
            site=None,
            host=None,
            port=None,
            attempt=record.attempt + 1,
            restarts=record.restarts + 1,
            start_at=0.0,
            started_at=None,
            running_at=None,
        )

    def move_for_size(self, record: Record, size: Size, why: str) -> tuple[str | None, str]:
        """Start another one of that size where there is room, for one whose site does not give it that.

        Returns:
            Where, or None, and what came of it in words.
        """
        coming = self._store.successor(record.id)
        if coming is not None:
            return None, f"{why}; instance {coming} is to take over already"
        wanted = self.successor_of(record, size=size)
        decision = self._weigh(wanted, self._promised())  # both of them, for a while
        if decision.site is None:
            return None, f"{why}, and nothing else takes it: {told(wanted, decision.refused)}"
        self._store.add(wanted, "", None, "")
        return decision.site, f"{why}: its robot is handed over to another one at {decision.site}"

    def _replace(self, record: Record, report: Report, now: float) -> None:
        if 0 <= now - (record.running_at or now) < self._timing.replace_pause or self._store.successor(record.id):
            return
        wanted = self.successor_of(record)
        others = self._promised([record])
        best = next(iter(self._weigh(wanted, others).scores), None)
        rtt_ms = None if report.rtt_s is None else report.rtt_s * 1000
        here = {record.site or "": Measurement(rtt_ms=rtt_ms).model_dump(exclude_none=True)}
        as_it_is = replace(wanted, replaces=None, measurements={**record.measurements, **here})
        scores = self._weigh(as_it_is, others, runs=True).scores
        present = next((s.total_ms for s in scores if s.site == record.site), None)
        # Only for what was measured, and only for a gain: else two bad sites would hand a robot to and fro.
        if best and best.measured and (present is None or best.total_ms + self._weights.migrate_ms < present):
            self._bad_since.pop(record.id, None)
            self._store.add(wanted, "", None, "")
            log.warning(
                "%s for %s (%s) is not good enough at %s: moving it to %s",
                *(record.service, record.robot, record.id, record.site, best.site),
            )

    def _drains(self, record: Record) -> bool:
        site = self._sites().find(record.site)
        return site is not None and (site.draining or site.evacuating)

    def _leaving(self, record: Record) -> str:
        """Why its site is about to end it; empty: it is not."""
        site = self._sites().find(record.site)
        if site is None:
            return ""
        drained = f"site {site.name} is being drained" if site.evacuating else ""
        return site.leaving.get(record.id, "") or drained

    def _reachable(self, record: Record) -> bool:
        site = self._sites().find(record.site)
        return site is not None and not site.unreachable


def _alike(spare: Record, record: Record) -> bool:
    """Same service, same version, same parameters."""
    return (spare.service, spare.manifest, spare.params) == (record.service, record.manifest, record.params)


def _document(manifest: Manifest) -> dict[str, Any]:
    return manifest.model_dump(mode="json", by_alias=True)


def told(record: Record, refused: Sequence[Refusal]) -> str:
    """All refusals in one sentence."""
    none = "no other" if record.replaces else "none"
    return "; ".join(f"{r.site}: {r.detail}" for r in refused) or f"there is {none}: add one with `skytether site add`"
