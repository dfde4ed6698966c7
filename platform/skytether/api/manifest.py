"""A service's manifest: what people write in YAML. Unknown keys are refused by name."""

from __future__ import annotations

import re
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

NAME = re.compile(r"[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?")
"""Names of services, sites and robots: a DNS label, so that every runtime can use them as they are."""

Name = Annotated[str, Field(pattern=rf"^{NAME.pattern}$", description="lower-case letters, digits and '-'")]
Tier = Literal["robot", "edge", "cloud"]
ANY_TOPIC = "*"
RELIABLE_LIFESPAN_MS = 60_000
"""How long a reliable topic tries by default."""
CALL_DEPTH = 64
"""Requests, and answers, that may be under way by default."""


class Strict(BaseModel):
    """Base of everything that people or programs send us: no unknown keys, no silent changes."""

    model_config = ConfigDict(extra="forbid", frozen=True, validate_default=True)


class TopicSpec(Strict):
    """One topic of a service, as the service sees it; units are in the names."""

    name: Annotated[str, Field(min_length=1, max_length=255)]
    """``*`` takes any topic that the robot offers (direction ``in`` only), with this row's quality of service."""
    kind: Literal["topic", "call"] = "topic"
    """A call is asked in the row's direction and answered in the other; its type is that of a ROS service,
    ``nav_msgs/srv/GetPlan``. It is reliable, and ``lifespan_ms`` and ``depth`` have defaults that suit it."""
    type: Annotated[str, Field(min_length=1, max_length=255)]
    """ROS 2 style name, ``geometry_msgs/msg/Twist``; ``*`` with name ``*``."""
    direction: Literal["in", "out"]
    type_hash: str = ""
    encoding: Literal["cdr", "ros1"] = "cdr"
    """A default: the robot's choice overrides it in the handshake."""
    priority: Annotated[int, Field(ge=0, le=127)] = 64
    period_ms: Annotated[float, Field(gt=0, lt=3_600_000)] | None = None
    lifespan_ms: Annotated[float, Field(gt=0, le=3_600_000)] = 100
    depth: Annotated[int, Field(ge=1, le=10_000)] = 1
    delivery: Annotated[float, Field(gt=0, lt=1)] = 0.99
    reliable: bool = False
    """Every message arrives once and in order, unless it is older than ``lifespan_ms`` (then a minute by default)."""
    latched: bool = False
    """The newest message of a reliable topic is kept and sent to whoever comes later."""
    compression: Literal["none", "zstd"] = "none"
    """Not for what is compressed already, such as camera images."""
    paths: Literal["failover", "redundant"] = "failover"
    """``redundant``: every message by two of the robot's networks, where it has several."""

    @model_validator(mode="before")
    @classmethod
    def _reliable_lives_long(cls, row: Any) -> Any:
        if not isinstance(row, dict):
            return row
        if row.get("kind") == "call":
            row = {"reliable": True, "depth": CALL_DEPTH, **row}
        return {"lifespan_ms": RELIABLE_LIFESPAN_MS, **row} if row.get("reliable") else row

    @model_validator(mode="after")
    def _reliability_fits(self) -> TopicSpec:
        if self.latched and not self.reliable:
            raise ValueError("latched: true needs reliable: true")
        if self.kind == "call" and (not self.reliable or self.latched or self.name == ANY_TOPIC):
            raise ValueError("kind: call is reliable and not latched, and has a name of its own")
        return self

    def rows(self) -> tuple[TopicSpec, ...]:
        """The topics that carry it: itself, or the request and the response of a call."""
        if self.kind == "topic":
            return (self,)
        row = self.model_copy(update={"kind": "topic"})
        there, back = self.direction, "out" if self.direction == "in" else "in"
        parts = (("request", "_Request", there), ("response", "_Response", back))
        return tuple(
            row.model_copy(update={"name": f"{self.name}/{part}", "type": self.type + suffix, "direction": direction})
            for part, suffix, direction in parts
        )

    @model_validator(mode="after")
    def _any_topic_comes_in(self) -> TopicSpec:
        if (self.name == ANY_TOPIC or self.type == ANY_TOPIC) and (self.name != self.type or self.direction != "in"):
            raise ValueError("name '*' needs type '*' and direction 'in'")
        return self


class Needs(Strict):
    """What a site and a link must offer before an instance may run there."""

    cpu: Annotated[float, Field(gt=0)] = 0.1
    """Cores."""
    memory_mb: Annotated[int, Field(gt=0)] = 128
    gpu: Annotated[int, Field(ge=0)] = 0
    compute_ms: Annotated[float, Field(gt=0, le=60_000)] = 5.0
    """One step of the service on a core of its own; placement reckons delay with it."""
    architectures: tuple[Annotated[str, Field(pattern=r"^[a-z0-9_]+$")], ...] = ()
    """As container images name them (``amd64``, ``arm64``); empty: any."""
    max_rtt_ms: Annotated[float, Field(gt=0)] | None = None
    """Above this the robot's fallback takes over; None: any."""
    max_loss: Annotated[float, Field(ge=0, le=1)] | None = None
    """Share of messages; above this the robot's fallback takes over; None: any."""
    tiers: Annotated[tuple[Tier, ...], Field(min_length=1)] = ("robot", "edge", "cloud")


class Metadata(Strict):
    """Who the service is."""

    name: Name
    version: Annotated[str, Field(min_length=1, max_length=64)] = "1"
    labels: dict[str, str] = {}


class ServiceSpec(Strict):
    """What runs, what it takes in and gives out, what it needs."""

    image: str | None = None
    """Container image; needed by container sites."""
    entrypoint: str | None = None
    """Python module with a ``__main__``; needed by process sites."""
    params: dict[str, Any] = {}
    """JSON schema (2020-12) of the parameters; ``additionalProperties`` is false unless it says otherwise."""
    topics: tuple[TopicSpec, ...] = ()
    needs: Needs = Needs()

    @model_validator(mode="after")
    def _can_run_and_names_are_unique(self) -> ServiceSpec:
        if not self.image and not self.entrypoint:
            raise ValueError("one of 'image' and 'entrypoint' is needed")
        names = [t.name for t in self.topics]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"topic '{name}' is listed twice")
        return self


class Manifest(Strict):
    """The whole document."""

    api_version: Annotated[Literal["skytether.io/v1"], Field(alias="apiVersion")]
    kind: Literal["Service"]
    metadata: Metadata
    spec: ServiceSpec
