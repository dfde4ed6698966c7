"""What is asked of groups of sites, as ``scaling`` sees it: what waits, and how their machines are; looks only."""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import replace

from pydantic_core import to_json

from skytether.api.groups import Stage
from skytether.api.rest import Measurement, Refusal, State

from ..config.settings import Weights
from ..domain.records import Record
from ..runtimes.base import Capacity
from ..scheduling.placement import UNSTARTED, Candidate, Prospect, place
from ..scheduling.promises import NOTHING, Sums
from ..scheduling.sites import Sites
from ..store.group_store import MachineRow
from ..store.store import Store
from .groups import Groups, SiteGroup
from .scaling import BACKOFF_MAX, GroupView, MachineView, Waiting

_UNKNOWN = Capacity(math.inf, 1 << 40, 1 << 20)
"""What a machine has where the provider has not said: nobody is sent away for that."""
_OF_ALL = ("runtime", "image", "architecture")
"""Reasons of a site's refusal that hold for all instances of a service, at all sites of a group."""
_FOR_GOOD = (*_OF_ALL, "rtt", "loss", UNSTARTED, "unfit")
"""Those that hold for an instance at all sites of a group: one more is no help."""
_MOST_FUTILE = 1024
"""Instances and services that are remembered; of more all are forgotten, and learnt again."""


class Demand:
    """Of all groups, as the database, their sites and their providers have it."""

    def __init__(
        self,
        store: Store,
        groups: Groups,
        sites: Sites,
        clock: Callable[[], float],
        weights: Weights,
        steady: Callable[[], float] = time.monotonic,
    ) -> None:
        """``clock`` gives seconds since the epoch, ``steady`` those of a clock that nobody sets."""
        self._store = store
        self._groups = groups
        self._sites = sites
        self._clock = clock
        self._weights = weights
        self._steady = steady

    def views(self, own: SiteGroup, promised: Sums) -> list[GroupView]:
        """Of all groups, for the thread of one of them; ``promised``: what sites have promised."""
        machines = self._store.machines()
        views = []
        for row in self._store.site_groups():
            group = self._groups.find(row.name)
            mine = [self._view(own, one, promised) for one in machines if one.group == row.name]
            offer = _least(group.offer, group.proven) if group else None
            retry_at = row.retry_at if row.retry_at - self._clock() <= BACKOFF_MAX else -math.inf  # another clock's
            views.append(GroupView(row.asked, offer, tuple(mine), row.failures, retry_at, row.draining))
        return views

    def _view(self, own: SiteGroup, row: MachineRow, promised: Sums) -> MachineView:
        site = self._sites.find(row.name)
        used = promised.get(row.name, NOTHING)
        takes = site is not None and not (site.unreachable or site.draining or site.evacuating)
        total = site.capacity if site is not None and takes else None
        free = Capacity(total.cpu - used.cpu, total.memory_mb - used.memory_mb, total.gpu - used.gpu) if total else None
        idle_since = None
        if row.stage is not Stage.READY or used.instances:
            own.idle_since.pop(row.name, None)
        elif row.group == own.name:
            steady = self._steady()
            idle_since = self._clock() - (steady - own.idle_since.setdefault(row.name, steady))
        return MachineView(
            row.name, row.stage, row.since, used.instances, free, total.cpu if total else 0.0, idle_since
        )

    def waiting(self, views: Iterable[GroupView]) -> list[Waiting]:
        """What no site takes, and the groups whose machines could take it, in the order of placement's score."""
        views = list(views)
        offers = {view.asked.name: view for view in views if view.offer is not None and not view.draining}
        if not offers:
            return []
        now = self._clock()
        wanted = {record.id: (record, record.created_at) for record in self._store.waiting()}
        # What runs where a machine is given back, and finds no room elsewhere.
        leaving = [one for view in views for one in view.machines if one.stage is Stage.DRAINING and one.instances]
        for machine in leaving:
            running = [one for one in self._store.live_at(machine.name) if one.state is State.RUNNING]
            wanted |= {one.id: (one, machine.since) for one in running if self._store.successor(one.id) is None}
        found = []
        for record, since in wanted.values():
            if record.standby or record.pinned is not None or record.lease_expires_at <= now:
                continue
            groups = self._could_take(record, offers)
            if groups:
                found.append(Waiting(record.id, record.spec.needs, since, groups))
        return found

    def prospects(self, record: Record) -> list[Prospect]:
        """What each group could do for an instance that no site takes; from any thread, for who leads or not."""
        found = []
        for group in self._groups.all():
            view = GroupView(group.asked, _least(group.offer, group.proven) or _UNKNOWN, draining=group.draining)
            candidate = replace(self._candidate(record, view), draining=group.draining)
            decision = place(record.spec.needs, {}, [candidate], image=record.spec.image, weights=self._weights)
            waits = Refusal(site=group.name, reason="group", detail=group.standing)
            found.append(Prospect(next(iter(decision.refused), waits), decision.hopeless))
        return found

    def _could_take(self, record: Record, offers: Mapping[str, GroupView]) -> tuple[str, ...]:
        group_of = {one.name: view.asked.name for view in offers.values() for one in view.machines}
        self._note_futile(record, group_of)
        useless = {name for name in offers if (group := self._groups.find(name)) and _is_futile(record, group.futile)}
        measured: dict[str, Measurement] = {}
        for site, given in record.measurements.items():
            name, one = group_of.get(site), Measurement.model_validate(given)
            if name and one.rtt_ms is not None and one.rtt_ms <= (measured.get(name, one).rtt_ms or math.inf):
                measured[name] = one
        spec = record.spec
        candidates = [self._candidate(record, view) for name, view in offers.items() if name not in useless]
        decision = place(spec.needs, measured, candidates, image=spec.image, weights=self._weights)
        return tuple(score.site for score in decision.scores)

    def _note_futile(self, record: Record, group_of: Mapping[str, str]) -> None:
        for refused in record.refused:
            group = self._groups.find(group_of.get(refused["site"], ""))
            if group is None or refused["reason"] not in _FOR_GOOD:
                continue
            if len(group.futile) >= _MOST_FUTILE:
                group.futile = set()
            group.futile.add(_service(record) if refused["reason"] in _OF_ALL else record.id)

    def _candidate(self, record: Record, view: GroupView) -> Candidate:
        asked = view.asked
        group = self._groups.find(asked.name)
        return Candidate(
            name=asked.name,
            tier=asked.tier,
            cannot_run=group.provider.refuses(record.spec) if group else "its group is not open yet",
            total=view.offer or Capacity(0.0, 0),
            speed=asked.speed,
            cost=asked.cost,
            images=asked.images,
        )


def _service(record: Record) -> str:
    """A service as it is: a changed manifest is another one."""
    return hashlib.blake2b(to_json(record.manifest), digest_size=12).hexdigest()


def _is_futile(record: Record, futile: Collection[str]) -> bool:
    return bool(futile) and (record.id in futile or _service(record) in futile)


def _least(one: Capacity | None, other: Capacity | None) -> Capacity | None:
    if one is None or other is None:
        return one
    least = min(one.cpu, other.cpu), min(one.memory_mb, other.memory_mb), min(one.gpu, other.gpu)
    return Capacity(*least, other.architecture or one.architecture)
