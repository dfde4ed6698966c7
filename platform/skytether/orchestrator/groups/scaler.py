"""Makes the machines of groups be what ``scaling`` decides, while this orchestrator leads.

Level-triggered, and safe to be killed anywhere: a machine's row is written before the machine is ordered, and goes only
when the provider lists it no more. Whatever was being done is seen from row, list and site, and done on.
"""

from __future__ import annotations

import logging
import secrets
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol

from skytether.api.groups import GroupCreate, Stage
from skytether.api.rest import SiteCreate

from ..domain.errors import DomainError, NotFoundError
from ..providers.base import Condition, Found, Invitation, Order, ProviderFailure, ProviderSilentError
from ..scheduling.promises import Sums
from ..scheduling.site import Site
from ..scheduling.sites import Sites
from ..scheduling.successors import Successors
from ..store.engine import GONE
from ..store.group_store import GroupRow, MachineRow
from ..store.leader import Lead, LeadLostError, fence, fenced
from ..store.store import Store
from .demand import Demand
from .groups import SiteGroup
from .scaling import BACKOFF_MAX, Drain, Make, Step, backoff, decide

log = logging.getLogger(__name__)

_REST = 2.0
"""Seconds between two passes over a group."""
_BUSY = 1.0
"""The same while a machine comes or goes."""
_GONE_AFTER = 30.0
"""Seconds for which a machine was not listed, and its site has not answered, until it is taken for gone."""
_OFFER_AGE = 60.0
"""Seconds between two looks of an orchestrator that does not lead at what a machine has."""


class Invites(Protocol):
    """Lets machines become sites by themselves."""

    def __call__(self, machine: str, group: GroupCreate, options: Mapping[str, Any]) -> Invitation:
        """For a site of this name, in place of those before, of the group's tier and so on, with these options.

        Raises:
            ProviderFailure: It cannot be.
        """
        ...


class Scaler:
    """Called by each group's thread, with the group."""

    def __init__(
        self,
        store: Store,
        sites: Sites,
        successors: Successors,
        demand: Demand,
        promised: Callable[[], Sums],
        lead: Lead,
        clock: Callable[[], float],
        invite: Invites,
        wake_placer: Callable[[], None] = lambda: None,
        forget_site: Callable[[str], None] = lambda _: None,
        steady: Callable[[], float] = time.monotonic,
    ) -> None:
        """What it works with.

        Args:
            store: Where groups and machines are.
            sites: Where machines become sites.
            successors: Moves what runs at a machine that is given back.
            demand: What is asked of the groups.
            promised: What sites have promised.
            lead: It acts while this leads.
            clock: Seconds since the epoch.
            invite: Lets a machine become a site by itself.
            wake_placer: Called when there is room for another.
            forget_site: Called with the name of a site or a group that is no more.
            steady: Seconds of a clock that nobody sets.
        """
        self._store = store
        self._sites = sites
        self._successors = successors
        self._demand = demand
        self._promised = promised
        self._lead = lead
        self._clock = clock
        self._invite = invite
        self._wake_placer = wake_placer
        self._forget_site = forget_site
        self._steady = steady

    def turn(self, group: SiteGroup) -> float:
        """One pass over a group; returns seconds until the next."""
        try:
            with fenced(self._lead.epoch):
                if not self._leads():
                    group.forget(-1)
                    if self._steady() - group.offered_at >= _OFFER_AGE:
                        self._ask_offer(group)
                    return _REST
                if group.epoch != fence():
                    group.forget(fence())
                return self._pass(group)
        except (LeadLostError, *GONE) as error:
            log.info("group %s: %s", group.name, error)
            return _REST

    def _leads(self) -> bool:
        return self._lead.leads and self._lead.epoch == fence()

    def _pass(self, group: SiteGroup) -> float:
        there = self._list_machines(group)
        row = self._store.site_group(group.name)
        if there is None or row is None:
            return _REST
        rows = self._store.machines(group.name)  # after the look: what has no row by now had none when it was listed
        self._destroy_strangers(group, rows, there)
        for machine in rows:
            self._follow(group, row, machine, sorted((f for f in there if f.name == machine.name), key=_age))
        views = self._demand.views(group, self._promised())
        now = self._clock()
        for step in decide(views, self._demand.waiting(views), now):
            if step.group == group.name and self._leads():
                self._do(group, step)
        rows = self._store.machines(group.name)
        group.standing = _standing(group, self._store.site_group(group.name) or row, rows)
        if row.draining and not rows and self._store.delete_site_group(group.name):
            log.info("group %s had no more machines, and was deleted", group.name)
            self._forget_site(group.name)
        return _BUSY if any(machine.stage is not Stage.READY for machine in rows) else _REST

    def _list_machines(self, group: SiteGroup) -> Sequence[Found] | None:
        """What is there; None: nobody knows."""
        obstacle = self._ask_offer(group)
        try:
            there = group.provider.machines()
        except ProviderFailure as error:
            there, obstacle = None, str(error)
        if obstacle and obstacle != group.obstacle:
            log.warning("group %s: %s", group.name, obstacle)
        group.obstacle = obstacle
        return there

    def _ask_offer(self, group: SiteGroup) -> str:
        """Why there is none; empty: there is."""
        group.offered_at = self._steady()
        try:
            group.offer = group.provider.offer()
        except ProviderFailure as error:
            group.offer = None
            return str(error)
        return ""

    # What is there, or should be

    def _destroy_strangers(self, group: SiteGroup, rows: Iterable[MachineRow], there: Iterable[Found]) -> None:
        known = {row.name for row in rows}
        for found in there:
            if found.name not in known and found.condition is not Condition.GOING:
                self._report(group, f"{found.name} is destroyed: nobody ordered it")
                self._destroy(group, found)

    def _follow(self, group: SiteGroup, row: GroupRow, machine: MachineRow, found: Sequence[Found]) -> None:
        """See how one machine is, and what that means."""
        if found:
            group.missing_since.pop(machine.name, None)
        if machine.stage is Stage.MAKING:
            self._follow_order(group, row, machine, found)
        elif machine.stage is Stage.REMOVING:
            self._remove(group, machine, found)
        else:
            mine = self._only_one(group, machine, found)
            site = self._sites.find(machine.name)
            if site is not None:
                site.group = group.name
            if why := self._lost(group, machine, mine, site):
                self._give_up(group, machine, site, why)
            elif machine.stage is Stage.JOINING:
                self._follow_joining(group, row, machine, site)
            elif site is None:
                if machine.stage is Stage.READY:
                    self._report(group, f"{machine.name} is given back: it is a site no more")
                why = machine.reason or "it is a site no more"
                self._store.advance_machine(machine.name, Stage.REMOVING, self._clock(), why)
            elif machine.stage is Stage.DRAINING:
                self._empty(site)
            elif site.draining:
                self._store.advance_machine(machine.name, Stage.DRAINING, self._clock(), "its site is drained")

    def _follow_order(self, group: SiteGroup, row: GroupRow, machine: MachineRow, found: Sequence[Found]) -> None:
        now = self._clock()
        if found:
            self._store.identify_machine(machine.name, found[0].id, now)
            self._only_one(group, replace(machine, provided=found[0].id), found)
        elif not 0 <= now - machine.since < group.provider.settle_s and not 0 < row.retry_at - now <= BACKOFF_MAX:
            # It may have been ordered, and nothing came of it; or its order was never sent.
            self._store.retry_machine(machine.name, now)
            self._order(group, machine.name)

    def _only_one(self, group: SiteGroup, machine: MachineRow, found: Sequence[Found]) -> Found | None:
        """The machine itself. Others of its name were made by a leader that was overtaken."""
        mine = next((one for one in found if one.id == machine.provided), None)
        for other in found:
            if other is not mine and other.condition is not Condition.GOING:
                self._report(group, f"{other.name} is there twice: {other.id} is destroyed")
                self._destroy(group, other)
        return mine

    def _lost(self, group: SiteGroup, machine: MachineRow, mine: Found | None, site: Site | None) -> str:
        """Why a machine will never be of use again; empty: it may be. One whose site answers is there."""
        if site is not None and not site.unreachable:
            return ""
        if mine is not None:
            return mine.reason or "it failed" if mine.condition is Condition.FAILED else ""
        since = group.missing_since.setdefault(machine.name, self._steady())
        gone_for = self._steady() - since
        patience = _GONE_AFTER if machine.stage is not Stage.JOINING else group.provider.settle_s
        return "somebody has deleted it" if gone_for >= patience else ""

    def _give_up(self, group: SiteGroup, machine: MachineRow, site: Site | None, why: str) -> None:
        if machine.stage is Stage.JOINING:
            self._failed(group, f"{machine.name}: {why}")
        else:
            self._report(group, f"{machine.name} is lost: {why}")
        self._store.advance_machine(machine.name, Stage.REMOVING, self._clock(), why)
        if site is None:
            return
        for record in self._store.live_at(site.name):
            self._successors.displace(record, f"the machine of site {site.name} is gone")
        self._empty(site)
        self._wake_placer()

    def _follow_joining(self, group: SiteGroup, row: GroupRow, machine: MachineRow, site: Site | None) -> None:
        if site is None:
            site = self._added(group, machine.name)
        if site is None or site.unreachable:
            return
        site.group = group.name
        if self._store.advance_machine(machine.name, Stage.READY, self._clock()):
            group.proven = site.capacity
            self._report(group, f"{machine.name} is a site")
            if row.failures:
                self._store.change_site_group(group.name, failures=0, retry_at=0.0, reason="")
            self._wake_placer()

    def _added(self, group: SiteGroup, name: str) -> Site | None:
        """The site of a machine that does not join by itself; None: it does, or cannot be one."""
        shape, asked = group.provider.site(name), group.asked
        if shape is None:
            return None
        site = SiteCreate(
            name=name,
            tier=asked.tier,
            runtime=shape.runtime,
            options=dict(shape.options),
            speed=asked.speed,
            cost=asked.cost,
            images=asked.images,
        )
        try:
            return self._sites.add(site)
        except DomainError as error:
            log.warning("group %s: %s is no site: %s", group.name, name, error)
            return None

    def _empty(self, site: Site) -> None:
        """Have a site go, and what runs there moved before."""
        try:
            if not site.evacuating:
                self._sites.evacuate(site.name)
            if not site.draining and self._sites.drain(site.name):
                self._forget_site(site.name)
        except NotFoundError:
            pass  # it is gone already
        except DomainError as error:
            log.info("site %s is not deleted yet: %s", site.name, error)

    def _remove(self, group: SiteGroup, machine: MachineRow, found: Sequence[Found]) -> None:
        site = self._sites.find(machine.name)
        if site is not None:  # it became one in the last moment, or is not empty yet
            self._empty(site)
            return
        for one in found:
            if one.condition is not Condition.GOING:
                self._destroy(group, one)
        if found:
            return
        if machine.provided is None:  # it may have been ordered, and is not listed yet
            gone = not 0 <= self._clock() - machine.since < group.provider.settle_s
        else:
            gone = self._destroy(group, Found(machine.provided, machine.name, Condition.GOING))
        if gone:
            self._store.forget_machines([machine.name])
            self._report(group, f"{machine.name} is destroyed")

    def _destroy(self, group: SiteGroup, found: Found) -> bool:
        """Whether the provider heard of it."""
        try:
            group.provider.destroy(found.id)
        except ProviderFailure as error:
            log.warning("group %s: %s is not destroyed yet: %s", group.name, found.name, error)
            return False
        return True

    # What is decided

    def _do(self, group: SiteGroup, step: Step) -> None:
        now = self._clock()
        if isinstance(step, Make):
            name = f"{group.name}-{secrets.token_hex(3)}"
            if self._store.add_machine(MachineRow(name, group.name, Stage.MAKING, now, reason=step.why)):
                self._report(group, f"{name} is made: {step.why}")
                self._order(group, name)
        elif isinstance(step, Drain):
            if self._store.advance_machine(step.machine, Stage.DRAINING, now, step.why):
                self._report(group, f"{step.machine} is given back: {step.why}")
                site = self._sites.find(step.machine)
                if site is not None:
                    self._empty(site)
        elif self._store.advance_machine(step.machine, Stage.REMOVING, now, step.why):
            self._report(group, f"{step.machine} is given back: {step.why}")
            if step.failed:
                self._failed(group, f"{step.machine}: {step.why}")

    def _order(self, group: SiteGroup, name: str) -> None:
        """Ask for a machine whose row is there."""
        provider = group.provider
        try:
            invitation = self._invite(name, group.asked, provider.site_options) if provider.joins else None
            id_ = provider.make(Order(name, group.asked.labels, invitation))
        except ProviderSilentError as error:
            self._failed(group, f"{name}: {error}")  # whether it is made, the next looks tell
        except ProviderFailure as error:
            self._store.forget_machines([name])
            self._failed(group, f"{name} is not made: {error}")
        else:
            self._store.identify_machine(name, id_, self._clock())

    def _failed(self, group: SiteGroup, why: str) -> None:
        row = self._store.site_group(group.name)
        failures = row.failures + 1 if row else 1
        wait = backoff(failures)
        retry_at = self._clock() + wait
        self._store.change_site_group(group.name, failures=failures, retry_at=retry_at, reason=why)
        self._report(group, f"{why}; none is made for {wait:g} s", logging.WARNING)

    def _report(self, group: SiteGroup, text: str, level: int = logging.INFO) -> None:
        log.log(level, "group %s: %s", group.name, text)
        self._store.note_site_group_event(group.name, self._clock(), text)


def _standing(group: SiteGroup, row: GroupRow, machines: Sequence[MachineRow]) -> str:
    """What a group does for those that wait, after its name."""
    if why := group.obstacle or row.reason:
        return f"can make no machine now: {why}"
    if sum(machine.stage.counts for machine in machines) >= row.asked.max:
        return f"has all the machines that it may have ({row.asked.max})"
    if any(machine.stage in (Stage.MAKING, Stage.JOINING) for machine in machines):
        return "a machine is being made"
    return "can make a machine"


def _age(found: Found) -> tuple[str, str]:
    return found.made_at, found.id
