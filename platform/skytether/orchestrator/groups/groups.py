"""Groups of sites: each has a provider, and a thread of its own, so that a slow cloud holds up no other."""

from __future__ import annotations

import logging
import math
import secrets
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from importlib.metadata import entry_points
from pathlib import Path

from typing_extensions import override

from skytether.api.groups import GroupCreate
from skytether.api.manifest import Strict
from skytether.api.validation_errors import Fault, known

from ..domain.errors import ConflictError, ForbiddenError, InvalidError, NotFoundError
from ..domain.validation import parse
from ..providers.base import Found, Order, Provider, ProviderFailure, ProviderSilentError
from ..runtimes.base import Capacity
from ..scheduling.loops import Loop
from ..store.engine import GONE
from ..store.group_store import GroupRow
from ..store.store import Store

log = logging.getLogger(__name__)

PROVIDERS = "skytether.providers"
_CLOSE_TIMEOUT = 5.0
_REFRESH = 2.0
"""Seconds between two looks for groups that another orchestrator added or deleted."""


def load_provider(name: str) -> type[Provider]:
    """Find a provider by its entry point.

    Raises:
        InvalidError: There is none, or it cannot be imported; the cause is told.
    """
    found = {point.name: point for point in entry_points(group=PROVIDERS)}
    if name not in found:
        there = ", ".join(sorted(found)) or "none"
        raise InvalidError([Fault("provider", f"there is no provider '{name}'; installed are: {there}")])
    try:
        loaded = found[name].load()
    except ImportError as error:
        raise InvalidError([Fault("provider", f"provider '{name}' cannot be used: {error}")]) from error
    if not (isinstance(loaded, type) and issubclass(loaded, Provider)):
        raise InvalidError([Fault("provider", f"entry point '{name}' is no Provider")])
    return loaded


class UnusableProvider(Provider):
    """Stands in for one that cannot be made (its extra was removed, say): the group is listed, with the reason."""

    Options = Strict

    def __init__(self, reason: str) -> None:
        self._reason = reason

    def offer(self) -> Capacity:
        raise ProviderSilentError(self._reason)

    @override
    def make(self, order: Order) -> str:
        raise ProviderSilentError(self._reason)

    def machines(self) -> Sequence[Found]:
        raise ProviderSilentError(self._reason)

    @override
    def destroy(self, machine: str) -> None:
        raise ProviderSilentError(self._reason)


class SiteGroup:
    """One group: its provider, and what is known of it now. Read from any thread, written by its own."""

    def __init__(self, row: GroupRow, provider: Provider, step: Callable[[SiteGroup], float]) -> None:
        self.asked = row.asked
        self.owner = row.owner
        self.provider = provider
        self.offer: Capacity | None = None
        """What one machine has; None: not known."""
        self.proven: Capacity | None = None
        """What the site of the last machine that joined has; None: not known. A system takes its part of a machine."""
        self.futile: set[str] = set()
        """Instances, and services, that one of its sites refused for good: no machine is made for them again."""
        self.obstacle = ""
        """Why its provider cannot be asked, or can make none; empty: it can."""
        self.draining = row.draining
        self.standing = "can make a machine"
        """What it does for those that wait, after its name."""
        self.offered_at = -math.inf
        """Steady seconds: when the offer was asked for last."""
        self.epoch = -1
        """Of the leader who saw what follows."""
        self.idle_since: dict[str, float] = {}
        """By machine: since when it has had no instance, by the steady clock."""
        self.missing_since: dict[str, float] = {}
        """By machine: since when its provider has not listed it, by the steady clock."""
        self.loop = Loop(f"group-{self.name}", lambda: step(self), time.monotonic)

    @property
    def name(self) -> str:
        return self.asked.name

    def forget(self, epoch: int) -> None:
        """Another leader looks anew: for how long things were as they are, it has not seen."""
        self.epoch, self.idle_since, self.missing_since = epoch, {}, {}


class Groups:
    """All groups, in memory and in the store."""

    _step: Callable[[SiteGroup], float]
    """What each group's thread does again and again; from `start` on."""

    def __init__(
        self,
        folder: Path,
        store: Store,
        find_provider: Callable[[str], type[Provider]] = load_provider,
        lacks: Callable[[], str] = str,
    ) -> None:
        """There are none before `start`.

        Args:
            folder: Where the providers keep what they note.
            store: The database.
            find_provider: Gives a provider by its name.
            lacks: What is to be set before machines can join by themselves; empty: nothing.
        """
        self._lacks = lacks
        self._folder = folder
        self._store = store
        self._find_provider = find_provider
        self._lock = threading.Lock()
        self._groups: dict[str, SiteGroup] = {}
        self._looker = Loop("groups", self._try_refresh, time.monotonic)

    def start(self, step: Callable[[SiteGroup], float], declared: Iterable[GroupCreate] = ()) -> None:
        """Open every group of the store.

        Args:
            step: What each group's thread does again and again, from now on.
            declared: Groups that are to be there, and as these.

        Raises:
            InvalidError: A declared one cannot be.
        """
        self._step = step
        for asked in declared:
            self._declare(asked)
        self.refresh()
        self._looker.start()

    def _declare(self, asked: GroupCreate) -> None:
        there = self._store.site_group(asked.name)
        if there is not None and there.asked.provider != asked.provider:
            text = f"its machines are made by '{there.asked.provider}': delete the group first, or name another"
            raise InvalidError([Fault(f"{asked.name}.provider", text)])
        row = GroupRow(asked, there.owner if there else _owner())
        self._make_provider(row).close()
        if there is None:
            self._store.add_site_group(row)  # or another orchestrator over this database has just done it
        elif asked != there.asked:
            self._store.change_site_group(asked.name, asked=asked)
            log.info("group %s is changed to what the sites file says", asked.name)

    def _try_refresh(self) -> float:
        try:
            self.refresh()
        except GONE as error:
            log.debug("groups are not looked at: %s", error)
        return _REFRESH

    def refresh(self) -> None:
        """Open and close what another orchestrator over the same database added, changed and deleted."""
        with self._lock:
            wanted = {row.name: row for row in self._store.site_groups()}
            gone = [
                group
                for name, group in self._groups.items()
                if name not in wanted or (wanted[name].asked, wanted[name].owner) != (group.asked, group.owner)
            ]
            for group in gone:
                del self._groups[group.name]
            for name, row in wanted.items():
                if name not in self._groups:
                    self._open(row, self._make_usable(row))
                self._groups[name].draining = row.draining
        for group in gone:
            _close(group)

    def add(self, asked: GroupCreate, *, by_owner: bool = True) -> SiteGroup:
        """A new group.

        Args:
            asked: As it was described.
            by_owner: By the operator of the state folder.

        Raises:
            ForbiddenError: Somebody else wants one.
            InvalidError: Provider or options are wrong, or name what the provider does not have.
            ConflictError: There is one of that name.
        """
        _must_own(by_owner)
        with self._lock:
            there = f"there is a group '{asked.name}' already: choose another name, or delete that first"
            if self._store.site_group(asked.name) is not None:
                raise ConflictError(there)
            row = GroupRow(asked, _owner())
            provider = self._make_provider(row)
            try:
                offer, obstacle = provider.offer(), ""
            except ProviderSilentError as error:
                offer, obstacle = None, str(error)
            except ProviderFailure as error:
                provider.close()
                raise InvalidError([Fault("options", str(error))]) from error
            if not self._store.add_site_group(row):  # by way of another orchestrator
                provider.close()
                raise ConflictError(there)
            group = self._open(row, provider)
            group.offer, group.obstacle = offer, obstacle
        return group

    def delete(self, name: str, *, drain: bool = False, by_owner: bool = True) -> bool:
        """Forget a group without machines; whether it is gone by now.

        Args:
            name: Which.
            drain: One that has some gives them back, and is forgotten with the last one.
            by_owner: By the operator of the state folder.

        Raises:
            ForbiddenError: Somebody else wants to.
            NotFoundError: There is none of that name.
            ConflictError: It has machines.
        """
        _must_own(by_owner)
        self.row(name)
        if drain:
            self._store.change_site_group(name, draining=True)
        if self._store.delete_site_group(name):
            self.refresh()
            return True
        if group := self.find(name):
            group.loop.wake()
        if drain:
            return False
        held = [machine.name for machine in self._store.machines(name)]
        raise ConflictError(
            f"group '{name}' has {len(held)} machines ({', '.join(held[:3])}): drain it: what runs there is moved, "
            "the machines are given back, and the group is deleted with the last one"
        )

    def row(self, name: str) -> GroupRow:
        """One group, as it is stored.

        Raises:
            NotFoundError: There is none of that name; the text names those there are.
        """
        row = self._store.site_group(name)
        if row is None:
            raise NotFoundError(f"there is no group '{name}'; {known(self._groups, name)}")
        return row

    def find(self, name: str) -> SiteGroup | None:
        return self._groups.get(name)

    def all(self) -> list[SiteGroup]:
        return sorted(self._groups.values(), key=lambda group: group.name)

    def stop(self) -> None:
        """Let go of all groups; their machines stay."""
        self._looker.stop(timeout=_CLOSE_TIMEOUT)
        for group in self.all():
            group.loop.stop(timeout=0)
        for group in self.all():
            _close(group)

    def _make_provider(self, row: GroupRow) -> Provider:
        kind = self._find_provider(row.asked.provider)
        if kind.joins and (lacks := self._lacks()):
            text = f"machines of '{row.asked.provider}' join by themselves: first set {lacks}"
            raise InvalidError([Fault("provider", text)])
        options = parse(kind.Options, row.asked.options, prefix=("options",))
        folder = self._folder / row.name
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        try:
            return kind(row.name, row.owner, folder, options)
        except ProviderFailure as error:
            raise InvalidError([Fault("options", str(error))]) from error

    def _make_usable(self, row: GroupRow) -> Provider:
        try:
            return self._make_provider(row)
        except InvalidError as error:
            log.error("group %s cannot be used: %s", row.name, error)
            return UnusableProvider(str(error))

    def _open(self, row: GroupRow, provider: Provider) -> SiteGroup:
        group = self._groups[row.name] = SiteGroup(row, provider, self._step)
        group.loop.start()
        return group


def _must_own(by_owner: bool) -> None:
    if not by_owner:
        raise ForbiddenError(
            "a group makes machines, at somebody's cost: only the token in the orchestrator's state folder "
            "(operator.token) may add or delete one"
        )


def _owner() -> str:
    return secrets.token_hex(6)


def _close(group: SiteGroup) -> None:
    group.loop.stop(timeout=_CLOSE_TIMEOUT)
    group.provider.close()
