"""Instances: asked for, placed, watched, resized and moved."""

from __future__ import annotations

from datetime import datetime
from enum import StrEnum
from typing import Annotated, Any

from pydantic import Field, model_validator

from skytether.api.manifest import Name, Needs, Strict, Topics
from skytether.api.pull_progress import PullProgress


class State(StrEnum):
    """Life of an instance: pending -> placing -> starting -> running -> stopping -> stopped, or failed."""

    PENDING = "pending"
    PLACING = "placing"
    STARTING = "starting"
    RUNNING = "running"
    STOPPING = "stopping"
    STOPPED = "stopped"
    FAILED = "failed"

    @property
    def final(self) -> bool:
        """Nothing comes after it."""
        return self in (State.STOPPED, State.FAILED)


class Measurement(Strict):
    """What a robot measured towards one site."""

    rtt_ms: Annotated[float, Field(ge=0, le=3_600_000)] | None = None
    """Median round trip."""
    jitter_ms: Annotated[float, Field(ge=0, le=3_600_000)] | None = None
    """How much longer a slow one takes than the median."""
    loss: Annotated[float, Field(ge=0, le=1)] | None = None
    preferred: bool = False
    """The robot has weighed all that it knows and wants this site: it goes before others that fit."""


Measurements = Annotated[dict[Name, Measurement], Field(max_length=256)]
"""By site; more sites than a robot could measure within its period."""


class InstanceCreate(Strict):
    """A robot asks for a service."""

    robot: Name
    service: Name
    params: dict[str, Any] = {}
    measurements: Measurements = {}
    """Sites not named are taken as unmeasured; of a site that is not there nothing is kept."""
    lease_s: Annotated[float, Field(ge=1, le=86_400)] = 15
    """The instance is stopped when it is not renewed for this long."""


class Refusal(Strict):
    """Why one site was not chosen: the number asked for and the number found."""

    site: str
    """Or a group of sites, where no site was chosen."""
    reason: str
    """Bounded, for metrics: ``tier``, ``architecture``, ``image``, ``cpu``, ``memory``, ``gpu``, ``rtt``, ``loss``,
    ``runtime``, ``draining``, ``start``, ``unfit``, ``unreachable``, ``blocked``; of a group that a machine may be
    made: ``group``."""
    detail: str


class Score(Strict):
    """What placement reckoned for a site that fits, in milliseconds; the lowest total is chosen."""

    site: str
    rtt_ms: float
    """Round trip with its jitter, or what was assumed for it."""
    measured: bool
    """Whether the robot measured it."""
    compute_ms: float
    queue_ms: float
    """Waiting for a processor."""
    cost_ms: float
    spread_ms: float

    @property
    def total_ms(self) -> float:
        """The sum."""
        return round(self.rtt_ms + self.compute_ms + self.queue_ms + self.cost_ms + self.spread_ms, 3)


class Placement(Strict):
    """Where an instance runs, and why not elsewhere."""

    site: str
    refused: tuple[Refusal, ...] = ()
    scores: tuple[Score, ...] = ()
    """Of the sites that fitted when it was placed, the best first."""


class Session(Strict):
    """The robot's half of a bridge session."""

    id: str
    """16 hexadecimal digits."""
    key: Annotated[str | None, Field(repr=False)] = None
    """32 bytes, base64. Never in an answer about an instance: whoever claimed it (``SessionClaim``) puts it here."""
    host: str | None = None
    """Where the service's end can be reached (the advertised, not the bound address); None until it is up."""
    port: int | None = None
    topics: Topics = ()
    needs: Needs = Needs()


class SessionClaim(Strict):
    """Ask for a session's key, which one claim gets, and no other."""

    claim: Annotated[str, Field(min_length=16, max_length=64, repr=False)]
    """Made up by whoever asks, and a secret: the same one gets the key again, if the answer was lost."""


class SessionKey(Strict):
    """The key of a session."""

    key: Annotated[str, Field(repr=False)]
    """32 bytes, base64."""


class Size(Strict):
    """What one instance may count on at its site."""

    cpu: float
    """Cores."""
    memory_mb: int
    """MiB."""

    def __str__(self) -> str:
        return f"{self.cpu:g} core{'' if self.cpu == 1 else 's'} and {self.memory_mb} MiB"


class Resize(Strict):
    """Give a running instance more or less, without a restart."""

    cpu: Annotated[float, Field(gt=0, le=10_000)] | None = None
    """Cores; None: as many as it has."""
    memory_mb: Annotated[int, Field(gt=0, le=100_000_000)] | None = None
    """MiB; None: as much as it has."""

    @model_validator(mode="after")
    def _changes_something(self) -> Resize:
        if self.cpu is None and self.memory_mb is None:
            raise ValueError("say what it is to have: cpu, memory_mb or both")
        return self


class Instance(Strict):
    """One running copy of a service, for one robot."""

    id: str
    robot: str
    service: str
    state: State
    reason: str = ""
    """One sentence a person can act on; empty while all is well."""
    pull: PullProgress | None = None
    """While its image is pulled, how far that is."""
    params: dict[str, Any] = {}
    placement: Placement | None = None
    size: Size | None = None
    """What it has: what its service needs, or what it was given since."""
    resize: Size | None = None
    """What it is about to have instead."""
    replaces: str | None = None
    """The instance that its robot is to let go as soon as this one runs."""
    successor: str | None = None
    """The instance that this one's robot is to change to as soon as that runs."""
    session: Session | None = None
    """None for a token that may not see it."""
    restarts: int = 0
    created_at: datetime
    updated_at: datetime
    lease_expires_at: datetime


class InstanceEvent(Strict):
    """A change of an instance's state or reason, or what its service reports, as server-sent events tell it."""

    id: int
    """Counts up; ``Last-Event-ID`` resumes after it."""
    instance: str
    at: datetime
    state: State
    reason: str = ""
    """Of a report: what the service says, a sentence for people."""
    code: str = ""
    """Of a report: what the service says, for programs; empty: a change."""
    pull: PullProgress | None = None
    """Of a change while the image is pulled: how far that is."""


class Migrate(Strict):
    """Move an instance: another one is started, and its robot changes to that once it runs."""

    site: Name | None = None
    """Where to; None: the best of the other sites."""
