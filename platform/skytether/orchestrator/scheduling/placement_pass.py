"""The pass over what has no site yet: each instance gets one, or waits and says why; and what is due once a second."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import zip_longest

from skytether.api.rest import State

from ..config.settings import ServerLimits, Timing
from ..domain.records import Change, Record
from ..domain.transitions import failed, starting, stopped, waiting
from ..store.store import Store
from ..telemetry.metrics import Metrics
from .leases import Leases
from .loops import rest_of
from .placement import UNSTARTED, explain_refusals
from .placer import Placer
from .plan import Expire, Place, plan
from .sites import Sites
from .standbys import Standbys
from .successors import Successors

_PRUNE = 60.0
"""Seconds between two looks for what is too old to keep."""
_PLACED_AT_ONCE = 16
"""Instances that get their sites in one transaction: each takes a server's disk, and keeps others from writing."""


class PlacementPass:
    """Places what waits, while this orchestrator leads; otherwise it looks which sites there are only."""

    def __init__(
        self,
        store: Store,
        sites: Sites,
        placer: Placer,
        leases: Leases,
        standbys: Standbys,
        successors: Successors,
        metrics: Metrics,
        timing: Timing,
        limits: ServerLimits,
        clock: Callable[[], float],
        steady: Callable[[], float] = time.monotonic,
    ) -> None:
        """``clock`` gives seconds since the epoch, ``steady`` those of a clock that nobody sets."""
        self._store = store
        self._sites = sites
        self._placer = placer
        self._leases = leases
        self._standbys = standbys
        self._successors = successors
        self._metrics = metrics
        self._timing = timing
        self._limits = limits
        self._clock = clock
        self._steady = steady
        self._due = -math.inf
        """Steady seconds: when the next whole pass is due."""
        self._pruned_at = -_PRUNE

    def turn(self) -> float:
        """As much of a pass of the placer as is due: woken between two whole ones, it places what waits only."""
        due = self._due - self._steady()
        if due <= 0:
            return self.step()
        return min(due, self.step(whole=False))

    def step(self, *, whole: bool = True) -> float:
        """One pass, whole or over what waits only; returns seconds until the next."""
        return self._leases.guarded(lambda: self._pass(whole))

    def _pass(self, whole: bool) -> float:
        if whole:
            self._sites.refresh()
        if not self._leases.leads():
            self._due = -math.inf  # who leads next, or again, begins with a look at all
            return self._timing.place
        began, times_set = time.thread_time(), self._leases.times_set
        live = self._store.live() if whole else self._store.waiting()
        now = self._leases.now()
        if times_set != self._leases.times_set:
            return 0.0  # what was read is dated by another clock
        if whole:
            self._placer.promise_anew(live)
            rest = rest_of(self._timing.place, time.thread_time() - began)
            self._give_up_siteless([record for record in live if record.site is not None], now)
        chosen: list[Change] = []
        for action in plan([record for record in live if record.site is None], {}, (), now, self._timing):
            if isinstance(action, Place):
                chosen += self._choose(action.record)
                if len(chosen) >= _PLACED_AT_ONCE:
                    self._place(chosen)
                    chosen = []
            elif isinstance(action, Expire):
                self._leases.expire(action.record)
        self._place(chosen)
        if whole or self._standbys.warms:
            self._standbys.keep()
        if not whole:
            return self._timing.place
        self._sites.end_drained(self._placer.occupied(), self._metrics.forget_site)
        self._successors.watch(live)
        if self._steady() - self._pruned_at >= _PRUNE:
            self._pruned_at = self._steady()
            self._prune(now)
        self._due = self._steady() + rest
        return rest

    def _give_up_siteless(self, placed: Sequence[Record], now: float) -> None:
        """End what was placed at a site in the moment when that was deleted: nobody else looks at it ever again."""
        missing = [record for record in placed if self._sites.find(record.site) is None]
        there = {site.name for site in self._store.sites()} if missing else set()  # those here may just be opened anew
        for record in missing:
            if record.site not in there:
                end = stopped if record.state is State.STOPPING else failed
                self._store.change(end(record, f"site '{record.site}' was deleted: ask again"), now)

    def _waits(self, record: Record) -> bool:
        """Whether its time to start is still to come; a wait longer than the longest was another clock's."""
        return 0 < record.start_at - self._clock() <= self._timing.backoff_max

    def _choose(self, record: Record) -> list[Change]:
        """How an instance gets a site, which is promised to it from then on; nothing: none takes it now."""
        promised = self._placer.promised()
        decision = self._placer.weigh(record, promised)
        untried = [refusal for refusal in record.refused if refusal["reason"] != UNSTARTED]
        if decision.site is None and len(untried) < len(record.refused) and not self._waits(record):
            decision = self._placer.weigh(replace(record, refused=untried), promised)  # it may have been mended
        instead = ""
        if decision.site is None and record.size is not None and record.replaces is None:
            as_its_manifest_says = self._placer.weigh(replace(record, size=None), promised)
            if as_its_manifest_says.site is not None:
                has, gets = record.has, replace(record, size=None).has
                instead = f"has {gets} instead of {has}: {explain_refusals(record, decision.refused)}"
                decision = as_its_manifest_says
        refused = [refusal.model_dump() for refusal in decision.refused]
        if refused != record.refused:
            self._metrics.refused(record.service, decision.refused)
        if decision.site is None:
            reason = f"waiting for a site: {explain_refusals(record, decision.refused)}"
            if reason != record.reason or record.state is not State.PENDING:
                self._store.change(waiting(record, reason, decision.refused), self._clock())
            return []
        change = starting(record, decision.site, decision.scores, decision.refused, instead)
        self._placer.hold(change.after)
        if (site := self._sites.find(decision.site)) is not None:
            site.fitness.placed(record, self._steady(), self._clock())
        return [change]

    def _place(self, chosen: Sequence[Change]) -> None:
        """Give instances the sites that were chosen for them, unless somebody changed them meanwhile."""
        if not chosen:
            return
        now, placed = self._clock(), list[Record | None]()
        try:
            placed = self._store.change_all(chosen, now)
        finally:
            for one, record in zip_longest(chosen, placed):
                if record is None:
                    self._placer.release(one.record)
        for record in filter(None, placed):
            self._metrics.phase(record, "placing", now - record.created_at)
        for name in {record.site for record in placed if record is not None}:
            if (site := self._sites.find(name)) is not None:
                site.wake()

    def _prune(self, now: float) -> None:
        limits = self._limits
        for instance, name in self._store.prune(now, limits.ended_age, limits.ended_count, limits.events):
            site = self._sites.find(name)
            if site is not None:
                site.ended -= {instance}  # the site's next whole pass finds it as a stranger, and removes it
