"""Groups of sites over REST: machines that are made while robots wait, and given back when they are idle."""

from __future__ import annotations

from datetime import datetime
from enum import StrEnum
from typing import Annotated, Any

from pydantic import Field, model_validator

from .manifest import Strict, Tier

LONGEST_NAME = 48
"""Of a group: the names of its machines are longer, and are names of sites."""
GroupName = Annotated[
    str,
    Field(
        pattern=rf"^[a-z0-9]([a-z0-9-]{{0,{LONGEST_NAME - 2}}}[a-z0-9])?$",
        description=f"lower-case letters, digits and '-', {LONGEST_NAME} at most",
    ),
]
Seconds = Annotated[float, Field(ge=0, le=86_400)]


class Stage(StrEnum):
    """Life of a machine: making -> joining -> ready -> draining -> removing."""

    MAKING = "making"
    """The provider is, or is about to be, asked for it."""
    JOINING = "joining"
    """The provider has it; it is not a site yet."""
    READY = "ready"
    """It is a site."""
    DRAINING = "draining"
    """Its site takes no more instances; what runs there is moved, or ends."""
    REMOVING = "removing"
    """Its site is gone; the provider is asked to destroy it until it has."""

    @property
    def counts(self) -> bool:
        """Whether it is, or will be, a place for instances."""
        return self in (Stage.MAKING, Stage.JOINING, Stage.READY)


class Headroom(Strict):
    """What is kept free, so that the next robot need not wait for a machine."""

    cpu: Annotated[float, Field(ge=0, le=10_000)] = 0.0
    """Cores that one of the group's sites has free: those of the largest service that is not to wait."""
    memory_mb: Annotated[int, Field(ge=0, le=1 << 30)] = 0
    """MiB that the same site has free."""
    share: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """Share of the cores of all the group's sites that is free."""


class GroupCreate(Strict):
    """Sites that are made and destroyed as they are needed."""

    name: GroupName
    provider: str
    """Entry point of group ``skytether.providers``."""
    options: dict[str, Any] = {}
    """The provider's own options; unknown ones are refused by name."""
    min: Annotated[int, Field(ge=0, le=1000)] = 0
    """Machines that are always there."""
    max: Annotated[int, Field(ge=1, le=1000)]
    """Machines at most, also those that are being made."""
    tier: Tier = "cloud"
    speed: Annotated[float, Field(gt=0, le=1000)] = 1.0
    """Of each machine's core, as a site's."""
    cost: Annotated[float, Field(ge=0, le=1_000_000)] = 0.0
    """Of one instance there, as a site's: placement weighs it, and decides by it which group grows."""
    images: tuple[Annotated[str, Field(min_length=1, max_length=255)], ...] = ("*",)
    """Patterns of the images that may run there, as a site's."""
    labels: dict[
        Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,62}$")], Annotated[str, Field(max_length=255)]
    ] = {}
    """What the provider notes at each machine, for bills and tools; nothing here depends on them."""
    headroom: Headroom = Headroom()
    grow_after_s: Seconds = 3.0
    """An instance that has waited for this long is worth a machine: most that wait find room before."""
    idle_s: Seconds = 600.0
    """A machine without instances for this long is given back, as far as ``min`` and ``headroom`` let it."""
    join_timeout_s: Annotated[float, Field(ge=1, le=86_400)] = 600.0
    """A machine that is not a site by then is destroyed, and another one is made, later each time."""
    parallel: Annotated[int, Field(ge=1, le=100)] = 2
    """Machines that are made at once, at most."""

    @model_validator(mode="after")
    def _min_is_not_above_max(self) -> GroupCreate:
        if self.min > self.max:
            raise ValueError(f"min is {self.min} and max {self.max}: min must not be above max")
        return self


class Machine(Strict):
    """One machine of a group. Its site has the same name."""

    name: str
    stage: Stage
    id: str | None = None
    """The provider's; None: it has not said yet."""
    since: datetime
    """Of the stage."""
    instances: int = 0
    reason: str = ""


class GroupEvent(Strict):
    """Something that was done, and why."""

    at: datetime
    text: str


class Group(GroupCreate):
    """A group and what is known of it."""

    draining: bool = False
    """Its machines are given back, and it is deleted with the last one."""
    reason: str = ""
    """What keeps it from making machines; empty: nothing."""
    retry_at: datetime | None = None
    """When it is tried again, after failures."""
    cpu: float | None = None
    """Cores of one machine; None: the provider has not said."""
    memory_mb: int | None = None
    machines: tuple[Machine, ...] = ()
    events: tuple[GroupEvent, ...] = ()
    """The last ones, newest first."""
