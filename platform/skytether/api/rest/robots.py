"""Robots: who they are, what they use, and orders to stop."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated

from pydantic import Field

from skytether.api.manifest import Name, Strict

from .reports import GateReport
from .tokens import TokenLife


class RobotBase(Strict):
    """What is known of a robot and may be changed by nobody but an operator."""

    name: Name
    services: tuple[str, ...] = ("*",)
    """What it may ask for; ``*``: anything."""
    group: Name | None = None
    """With whom its services share what they see: with the same services of the group's other robots. None: nobody."""


class RobotGroup(Strict):
    """Put a robot into a group, or out of its group."""

    group: Name | None


class RobotCreate(RobotBase):
    """Register a robot."""

    token_ttl_s: TokenLife | None = None
    """How long its first token is good for; None: until it is deleted."""


class RobotUse(Strict):
    """What a robot's instances that have not ended ask for, and what it may have; see the orchestrator's ``quotas``."""

    instances: int = 0
    cpu: float = 0.0
    """Cores."""
    memory_mb: int = 0
    streams: int = 0
    """Logs and events that it follows at the orchestrator that was asked."""
    data_mb: int = 0
    """MiB that its services have written and left at all sites, as the orchestrator that leads weighed them last."""


class StopRobot(Strict):
    """Stop a robot from afar."""

    reason: Annotated[str, Field(min_length=1, max_length=200)]
    """For the person who stands before it."""


class StopOrder(Strict):
    """An order to stop. The robot stands until a person beside it resets it; nobody can reset it from afar."""

    id: Annotated[str, Field(max_length=64)]
    """A robot keeps those that it obeyed."""
    robot: str
    reason: str
    by: str
    """Who gave it, as the audit names them."""
    at: datetime
    acknowledged_at: datetime | None = None
    """When the robot said that it stands; None: it has not said so yet."""


class Robot(RobotBase):
    """A registered robot."""

    created_at: datetime
    last_seen_at: datetime | None = None
    use: RobotUse = RobotUse()
    quota: RobotUse = RobotUse()
    """The most that it may have of each."""
    stop: StopOrder | None = None
    """The last order to stop; None: there was none."""
    gate: GateReport | None = None
    """As the robot said last; None: it has no gate, or has not said how that is for `timing.gate_silent`."""
    gate_heard_at: datetime | None = None
    """When it said so; None: never."""


class RobotCreated(Robot):
    """Answer to a registration: the only time that the token is shown."""

    token: Annotated[str, Field(repr=False)]
