"""Where an instance would run now: weighed against the sites there are, and what these have promised.

It looks, and keeps the sums of what is promised; what becomes of the answer is for who asked to do.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

from skytether.api.rest import Measurement, Size

from ..access.disk_usage import DiskUsage
from ..config.settings import Weights
from ..domain.records import Record
from ..runtimes.base import Capacity
from ..store.leader import ALONE, Lead
from ..store.store import Store
from .placement import UNSTARTED, Candidate, PlacementDecision, Prospect, lacks, place
from .promises import NOTHING, Promises, Sums
from .site import Site
from .sites import Sites

_PROMISES_AGE = 3.0
"""Seconds for which sums are good enough for a request at an orchestrator that does not lead."""


def _none_grows(_: Record) -> Sequence[Prospect]:
    return ()


class Placer:
    """Asked by requests, and by the passes of the reconciler. Safe from any thread."""

    def __init__(
        self,
        store: Store,
        sites: Sites,
        weights: Weights,
        lead: Lead = ALONE,
        steady: Callable[[], float] = time.monotonic,
        site_instances: int = sys.maxsize,
        disk_usage: DiskUsage | None = None,
        prospects: Callable[[Record], Sequence[Prospect]] = _none_grows,
    ) -> None:
        """What it weighs.

        Args:
            store: Where records are.
            sites: Where they could run.
            weights: What money, crowding and a change are worth, in milliseconds.
            lead: Whose sums are of this moment; at others they are some seconds old at most.
            steady: Seconds of a clock that nobody sets.
            site_instances: A site gets no more.
            disk_usage: A site gets nothing more where this says that it is full.
            prospects: What groups of sites could still do for an instance that no site takes.
        """
        self._store = store
        self._sites = sites
        self._weights = weights
        self._lead = lead
        self._steady = steady
        self._site_instances = site_instances
        self._disk_usage = disk_usage
        self._prospects = prospects
        self._promises = Promises()
        """As of the last whole pass of the placer, and what this orchestrator has changed since."""
        self._promises_until = -math.inf
        """Steady seconds."""

    def weigh(self, record: Record, promised: Sums | None = None, runs: bool = False) -> PlacementDecision:
        """Where it would run now, beside what is promised; looks only. ``runs``: it need not be started any more.

        Without ``promised``, beside all that is stored.
        """
        if promised is None:
            promised = Promises(self._store.live()).sums(self._leaving())
        measured = {site: Measurement.model_validate(m) for site, m in record.measurements.items()}
        sites = self._candidates(record, promised)
        if runs:
            sites = [replace(site, blocked=None, unfit=None) for site in sites]
        spec = record.spec
        decision = place(spec.needs, measured, sites, image=spec.image, weights=self._weights)
        if decision.site is not None or record.pinned is not None or record.standby:
            return decision
        prospects = self._prospects(record)
        return replace(
            decision,
            refused=(*decision.refused, *(prospect.refusal for prospect in prospects)),
            hopeless=decision.hopeless and all(prospect.hopeless for prospect in prospects),
        )

    def _candidates(self, record: Record, promised: Sums) -> list[Candidate]:
        """Sites where it may be, as they are now."""
        tried = {refusal["site"]: refusal["detail"] for refusal in record.refused if refusal["reason"] == UNSTARTED}
        full = self._disk_usage.full() if self._disk_usage is not None else {}
        now, most, found = self._steady(), self._site_instances, list[Candidate]()
        for site in self._sites.all():
            if not self._allows(record, site):
                continue
            has = promised.get(site.name, NOTHING)
            unfit = None if record.pinned else site.fitness.objection(record, now)
            one = site.candidate(record.spec, has.capacity, tried.get(site.name), unfit)
            if has.instances >= most:
                text = f"{has.instances} instances are there, and {most} may be (quotas.site_instances)"
                one = replace(one, full=text)
            elif site.name in full:
                one = replace(one, full=full[site.name])
            found.append(one)
        return found

    def _allows(self, record: Record, site: Site) -> bool:
        """One that replaces another does not go where that is.

        Unless it was told to, or that one is ended there, or it is there for being larger or smaller.
        """
        if record.pinned is not None:
            return site.name == record.pinned
        replaced = self._store.get(record.replaces) if record.replaces else None
        if replaced is None or site.name != replaced.site or replaced.id in site.leaving:
            return True
        return record.has != replaced.has

    def _leaving(self) -> set[str]:
        """What sites are about to end: it takes no room of what they have left."""
        return {instance for site in self._sites.all() for instance in site.leaving}

    def promise_anew(self, live: Iterable[Record]) -> None:
        """What sites have promised is what these hold: all that has not ended."""
        self._promises = Promises(live)
        self._promises_until = self._steady() + _PROMISES_AGE

    def promised(self, without: Iterable[Record] = ()) -> Sums:
        """What sites have promised, to all but these and what they are about to end.

        As whoever leads knows it, at others some seconds old at most.
        """
        if not self._lead.leads and self._steady() >= self._promises_until:  # only the placer replaces what it adds to
            self.promise_anew(self._store.live())
        return self._promises.sums({record.id for record in without} | self._leaving())

    def hold(self, record: Record) -> None:
        """It holds more or less at its site than before; the next whole pass of the placer knows it anyway."""
        self._promises.add(record)

    def release(self, record: Record) -> None:
        """It holds nothing any more."""
        self._promises.remove(record)

    def occupied(self) -> set[str]:
        """Names of sites that hold instances."""
        return {name for name, sum_ in self._promises.sums().items() if sum_.instances}

    def room(self, site: Site) -> Size:
        """What a site has beside what it has promised."""
        capacity, promised = site.capacity or Capacity(0.0, 0), self.promised().get(site.name, NOTHING)
        return Size(cpu=capacity.cpu - promised.cpu, memory_mb=capacity.memory_mb - promised.memory_mb)

    def lacks(self, record: Record, size: Size) -> str:
        """Why an instance cannot have this at its site, beside all that is stored; empty: it can."""
        site = self._sites.find(record.site)
        if site is None:
            return f"site '{record.site}' was deleted"
        promised = Promises(self._store.live()).sums(self._leaving() | {record.id})
        used = promised.get(site.name, NOTHING).capacity
        found = lacks(record.sized(size).needs, site.capacity or Capacity(0.0, 0), used)
        return "" if found is None else found[1]
