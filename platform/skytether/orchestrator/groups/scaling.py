"""How many machines a group of sites should have, and which one goes: pure.

A group grows for instances that wait and that a machine of it could take, for its ``min``, and for its head-room. It
shrinks by machines that have been idle for long, as far as the rest is enough. Two things keep it from doing both in
turn: an instance must have waited, and a machine must have been idle, for a while; and whatever a smaller group would
grow for keeps it from getting smaller.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from skytether.api.groups import GroupCreate, Headroom, Stage
from skytether.api.manifest import Needs

from ..runtimes.base import Capacity

_ROUNDING = 1e-9
"""Cores are fractions; ten times 0.1 must fit into 1."""
BACKOFF = 10.0
"""Seconds without another try after a machine that was not made, or did not become a site; doubles with each."""
BACKOFF_MAX = 600.0


@dataclass(frozen=True, slots=True)
class MachineView:
    """A machine as it is now."""

    name: str
    stage: Stage
    since: float
    """Of the stage [s since the epoch]."""
    instances: int = 0
    free: Capacity | None = None
    """What instances can still have there; None: it is no site yet, or its site does not answer."""
    cpu: float = 0.0
    """Cores of its site, used or not."""
    idle_since: float | None = None
    """Since when no instance has been there [s since the epoch]; None: some are."""


@dataclass(frozen=True, slots=True)
class GroupView:
    """A group as it is now."""

    asked: GroupCreate
    offer: Capacity | None
    """What one machine has; None: its provider has not said, so none is made for those that wait."""
    machines: tuple[MachineView, ...] = ()
    failures: int = 0
    """Machines in a row that were not made, or did not become sites."""
    retry_at: float = -math.inf
    """None is made before this [s since the epoch]."""
    draining: bool = False
    """It is to be deleted."""


@dataclass(frozen=True, slots=True)
class Waiting:
    """An instance that no site takes at present."""

    id: str
    needs: Needs
    since: float
    """[s since the epoch]."""
    groups: tuple[str, ...]
    """Those whose machines could take it, the best first."""


@dataclass(frozen=True, slots=True)
class Make:
    """Make a machine."""

    group: str
    why: str


@dataclass(frozen=True, slots=True)
class Drain:
    """Let a machine's site take no more, and then give the machine back."""

    group: str
    machine: str
    why: str


@dataclass(frozen=True, slots=True)
class Drop:
    """Give back a machine that is no site."""

    group: str
    machine: str
    why: str
    failed: bool
    """It should have become one."""


Step = Make | Drain | Drop


@dataclass(slots=True)
class _Room:
    """Of one machine, there or to come, for what has not been placed yet."""

    cpu: float
    memory_mb: float
    gpu: float
    machine: str = ""
    """Empty: it is to be made."""
    taken: bool = False

    def reserve(self, needs: Needs) -> bool:
        wanted = (needs.cpu, self.cpu), (needs.memory_mb, self.memory_mb), (needs.gpu, self.gpu)
        if any(need > there + _ROUNDING for need, there in wanted):
            return False
        self.cpu -= needs.cpu
        self.memory_mb -= needs.memory_mb
        self.gpu -= needs.gpu
        self.taken = True
        return True


@dataclass(slots=True)
class _Plan:
    """What one group is to become."""

    view: GroupView
    rooms: list[_Room] = field(default_factory=list)
    cores: float = 0.0
    """Of all its machines, with those to come."""
    new: list[str] = field(default_factory=list)
    """Why, of each machine to be made."""
    count: int = 0
    """Machines that are, or will be, places, without new ones."""

    @property
    def name(self) -> str:
        return self.view.asked.name

    @property
    def full(self) -> bool:
        return self.count + len(self.new) >= self.view.asked.max

    def more(self, why: str) -> _Room:
        offer = self.view.offer or Capacity(0.0, 0)
        self.new.append(why)
        self.cores += offer.cpu
        self.rooms.append(_Room(offer.cpu, offer.memory_mb, offer.gpu))
        return self.rooms[-1]


def decide(groups: Iterable[GroupView], waiting: Iterable[Waiting], now: float) -> list[Step]:
    """All that is due.

    All groups are decided on together: each instance that waits is worth one place, in the group that suits it best and
    can have one more machine.

    Args:
        groups: All of them.
        waiting: What no site takes.
        now: Seconds since the epoch.
    """
    steps: list[Step] = []
    plans: dict[str, _Plan] = {}
    for view in groups:
        leaving = _overdue(view, now) if not view.draining else _all_of(view)
        steps += leaving
        gone = {step.machine for step in leaving}
        plans[view.asked.name] = _planned(view, gone)
    wanted = _assign(plans, waiting, now)
    for plan in plans.values():
        if plan.view.draining:
            continue
        _keep_least(plan)
        ready = _shrunk(plan, now) if not plan.new and plan.name not in wanted else []
        steps += ready
        steps += [Make(plan.name, why) for why in plan.new[: _at_once(plan.view, now)]]
    return steps


def backoff(failures: int) -> float:
    """Seconds without another try after so many failures in a row."""
    return min(BACKOFF * 2.0 ** min(failures - 1, 64), BACKOFF_MAX) if failures > 0 else 0.0


def has_headroom(headroom: Headroom, free: Sequence[tuple[float, float]], cores: float) -> bool:
    """Whether enough is free.

    Args:
        headroom: How much.
        free: Cores and MiB that are free, by site.
        cores: Of all sites, used or not.
    """
    one = not (headroom.cpu or headroom.memory_mb) or any(
        cpu >= headroom.cpu - _ROUNDING and memory >= headroom.memory_mb for cpu, memory in free
    )
    # Nothing of nothing is free: a share is of what is there.
    return one and (not headroom.share or sum(cpu for cpu, _ in free) >= headroom.share * cores > 0.0)


def _overdue(view: GroupView, now: float) -> list[Drain | Drop]:
    """What did not become a site in time, or is none that is of use; and what is too many."""
    asked, steps = view.asked, list[Drain | Drop]()
    for one in view.machines:
        waited = now - one.since
        if one.stage is Stage.JOINING and waited >= asked.join_timeout_s:
            why = f"it did not become a site within {asked.join_timeout_s:g} s"
            steps.append(Drop(asked.name, one.name, why, failed=True))
        elif one.stage is Stage.READY and one.free is None and _idle(view, one, now):
            # It counts towards max and is of no use; one where something runs may be cut off, and drive a robot.
            steps.append(Drain(asked.name, one.name, "its site takes nothing, and nothing runs there"))
    gone = {step.machine for step in steps}
    there = [one for one in view.machines if one.stage.counts and one.name not in gone]
    # Those first that are furthest from use.
    there.sort(key=lambda one: (one.stage is Stage.READY, one.instances, one.name))
    for one in there[: max(0, len(there) - asked.max)]:
        steps.append(_give_back(view, one, f"the group may have {asked.max} machines"))
    return steps


def _idle(view: GroupView, one: MachineView, now: float) -> bool:
    return one.idle_since is not None and now - one.idle_since >= view.asked.idle_s


def _all_of(view: GroupView) -> list[Drain | Drop]:
    return [_give_back(view, one, "the group is to be deleted") for one in view.machines if one.stage.counts]


def _give_back(view: GroupView, one: MachineView, why: str) -> Drain | Drop:
    if one.stage is Stage.READY:
        return Drain(view.asked.name, one.name, why)
    return Drop(view.asked.name, one.name, why, failed=False)


def _planned(view: GroupView, gone: set[str]) -> _Plan:
    plan = _Plan(view)
    for one in view.machines:
        if not one.stage.counts or one.name in gone:
            continue
        plan.count += 1
        offer = one.free if one.stage is Stage.READY else view.offer
        if offer is not None:
            plan.cores += one.cpu if one.stage is Stage.READY else offer.cpu
            plan.rooms.append(_Room(offer.cpu, offer.memory_mb, offer.gpu, one.name))
    return plan


def _assign(plans: Mapping[str, _Plan], waiting: Iterable[Waiting], now: float) -> set[str]:
    """Give each that waits a place, one to be made where there is none; names of groups that it counts on."""
    counted_on = set()
    for one in sorted(waiting, key=lambda one: (one.since, one.id)):
        for plan in (plans[name] for name in one.groups if name in plans):
            view = plan.view
            if view.draining:
                continue
            found = any(room.reserve(one.needs) for room in plan.rooms)
            if not found and (plan.full or view.offer is None or now < view.retry_at):
                continue
            counted_on.add(plan.name)
            if not found and now - one.since >= view.asked.grow_after_s:
                plan.more(_waits(one)).reserve(one.needs)
            break
    return counted_on


def _waits(one: Waiting) -> str:
    needs = one.needs
    gpu = f", {needs.gpu} GPUs" if needs.gpu else ""
    return f"instance {one.id} waits for {needs.cpu:g} cores and {needs.memory_mb} MiB{gpu}"


def _keep_least(plan: _Plan) -> None:
    """Have as many as are always there, and what is kept free."""
    asked, headroom = plan.view.asked, plan.view.asked.headroom
    while plan.count + len(plan.new) < asked.min:
        plan.more(f"{asked.min} are always there")
    if headroom == Headroom() or plan.view.offer is None:
        return
    while not plan.full and not has_headroom(headroom, _free(plan.rooms), plan.cores):
        plan.more(f"{_told(headroom)} are kept free")


def _free(rooms: Iterable[_Room]) -> list[tuple[float, float]]:
    return [(room.cpu, room.memory_mb) for room in rooms]


def _told(headroom: Headroom) -> str:
    parts = (
        f"{headroom.cpu:g} cores" if headroom.cpu else "",
        f"{headroom.memory_mb} MiB" if headroom.memory_mb else "",
        f"{headroom.share:.0%} of the cores" if headroom.share else "",
    )
    return " and ".join(filter(None, parts))


def _at_once(view: GroupView, now: float) -> int:
    """How many may be begun now: after a failure one, to see whether it goes again."""
    if now < view.retry_at:
        return 0
    under_way = sum(one.stage in (Stage.MAKING, Stage.JOINING) for one in view.machines)
    return max(0, (1 if view.failures else view.asked.parallel) - under_way)


def _shrunk(plan: _Plan, now: float) -> list[Step]:
    """The machines that are idle for long, the longest first, while the ready ones that stay are enough."""
    view, asked = plan.view, plan.view.asked
    ready = {one.name: one for one in view.machines if one.stage is Stage.READY and one.free is not None}
    rooms = [room for room in plan.rooms if room.machine in ready]
    idle = [one for one in ready.values() if _idle(view, one, now)]
    idle.sort(key=lambda one: (one.idle_since or 0.0, one.name))
    steps: list[Step] = []
    for one in idle:
        rest = [room for room in rooms if room.machine != one.name]
        cores = sum(ready[room.machine].cpu for room in rest)
        enough = asked.headroom == Headroom() or has_headroom(asked.headroom, _free(rest), cores)
        if plan.count - len(steps) > asked.min and enough:
            rooms = rest
            steps.append(Drain(asked.name, one.name, f"it was idle for {now - (one.idle_since or now):.0f} s"))
    return steps
