"""Groups of sites and their machines, as the database keeps them. Times are seconds since the epoch.

The stages of a machine go one way only (`skytether.api.groups.Stage`), and a machine is destroyed only after its row
says so: whoever was overtaken by another leader in between does nothing that the next one would not do.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Row, delete, exists, select, update

from skytether.api.groups import GroupCreate, Stage

from .database import Database
from .models import machines, site_groups

_EVENTS = 20
"""That are kept of each group."""
_LONGEST = 1024
_BEFORE = {stage: list(Stage)[:n] for n, stage in enumerate(Stage)}
"""By stage, those from which a machine may come to it."""


@dataclass(frozen=True, slots=True)
class GroupRow:
    """A group, and how its provider does."""

    asked: GroupCreate
    owner: str
    """Word by which its machines are found again."""
    draining: bool = False
    """It is deleted with its last machine."""
    failures: int = 0
    """Machines in a row that were not made, or did not become sites."""
    retry_at: float = 0.0
    """None is made before this."""
    reason: str = ""
    """Of the last failure; empty: the last machine became a site."""
    told: tuple[tuple[float, str], ...] = ()
    """When, and what was done and why; oldest first."""

    @property
    def name(self) -> str:
        return self.asked.name


@dataclass(frozen=True, slots=True)
class MachineRow:
    """A machine that is to be made, is there, or is to be destroyed."""

    name: str
    group: str
    stage: Stage
    since: float
    """Of the stage."""
    provided: str | None = None
    """The provider's id; None: it has not said yet."""
    reason: str = ""


class GroupStore(Database):
    """The database with groups of sites. Safe from any thread."""

    def site_groups(self) -> list[GroupRow]:
        """All, by name."""
        with self._reader.connect() as connection:
            return [_group(row) for row in connection.execute(select(site_groups).order_by(site_groups.c.name))]

    def site_group(self, name: str) -> GroupRow | None:
        with self._reader.connect() as connection:
            row = connection.execute(select(site_groups).where(site_groups.c.name == name)).one_or_none()
        return _group(row) if row else None

    def add_site_group(self, group: GroupRow) -> bool:
        """False if there is one of that name."""
        return self._insert(
            site_groups, {"name": group.name, "asked": group.asked.model_dump(mode="json"), "owner": group.owner}
        )

    def change_site_group(self, name: str, **values: Any) -> None:
        """Set ``asked``, ``draining``, ``failures``, ``retry_at`` or ``reason``."""
        if "asked" in values:
            values["asked"] = values["asked"].model_dump(mode="json")
        if "reason" in values:
            values["reason"] = values["reason"][:_LONGEST]
        with self._writing() as connection:
            connection.execute(update(site_groups).where(site_groups.c.name == name).values(**values))

    def note_site_group_event(self, name: str, now: float, text: str) -> None:
        """Keep what was done, beside the last ones."""
        mine = site_groups.c.name == name
        with self._writing() as connection:
            told = connection.scalar(select(site_groups.c.told).where(mine).with_for_update())
            if told is not None:
                told = [*told, [now, text[:_LONGEST]]][-_EVENTS:]
                connection.execute(update(site_groups).where(mine).values(told=told))

    def delete_site_group(self, name: str) -> bool:
        """False: it has machines."""
        none = ~exists().where(machines.c.site_group == name)
        with self._writing() as connection:
            connection.execute(delete(site_groups).where(site_groups.c.name == name, none))
            there = select(site_groups.c.name).where(site_groups.c.name == name)
            return connection.execute(there).one_or_none() is None

    def machines(self, group: str | None = None) -> list[MachineRow]:
        """Of a group, or of all, by name."""
        query = select(machines).order_by(machines.c.name)
        if group is not None:
            query = query.where(machines.c.site_group == group)
        with self._reader.connect() as connection:
            return [_machine(row) for row in connection.execute(query)]

    def add_machine(self, machine: MachineRow) -> bool:
        """False if there is one of that name, or no such group any more."""
        row = {"name": machine.name, "site_group": machine.group, "stage": machine.stage.value, "since": machine.since}
        return self._insert(machines, {**row, "provided": machine.provided, "reason": machine.reason[:_LONGEST]})

    def advance_machine(self, name: str, stage: Stage, now: float, reason: str = "") -> bool:
        """To a later stage; False: it is there, or further, by now, or is gone."""
        mine = (machines.c.name == name) & machines.c.stage.in_(_BEFORE[stage])
        changed = update(machines).where(mine).values(stage=stage.value, since=now, reason=reason[:_LONGEST])
        with self._writing() as connection:
            return connection.execute(changed).rowcount == 1

    def identify_machine(self, name: str, provided: str, now: float) -> bool:
        """Note the provider's id of one that is being made; False: it has one, or is to be destroyed."""
        mine = (machines.c.name == name) & (machines.c.stage == Stage.MAKING.value) & machines.c.provided.is_(None)
        joining = update(machines).where(mine).values(stage=Stage.JOINING.value, since=now, provided=provided)
        with self._writing() as connection:
            return connection.execute(joining).rowcount == 1

    def retry_machine(self, name: str, now: float) -> None:
        """Its making begins anew: nothing came of the order before."""
        mine = (machines.c.name == name) & (machines.c.stage == Stage.MAKING.value) & machines.c.provided.is_(None)
        with self._writing() as connection:
            connection.execute(update(machines).where(mine).values(since=now))

    def forget_machines(self, names: Iterable[str]) -> None:
        """They are destroyed."""
        with self._writing() as connection:
            connection.execute(delete(machines).where(machines.c.name.in_(list(names))))


def _group(row: Row[Any]) -> GroupRow:
    told = tuple((float(at), str(text)) for at, text in row.told)
    asked = GroupCreate.model_validate(row.asked)
    return GroupRow(asked, row.owner, row.draining, row.failures, row.retry_at, row.reason, told)


def _machine(row: Row[Any]) -> MachineRow:
    return MachineRow(row.name, row.site_group, Stage(row.stage), row.since, row.provided, row.reason)
