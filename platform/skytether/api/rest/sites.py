"""Sites, and machines that join as one."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import Field

from skytether.api.manifest import Name, Strict, Tier


class SiteCreate(Strict):
    """A place where instances run."""

    name: Name
    tier: Tier
    runtime: str
    """Entry point of group ``skytether.runtimes``."""
    options: dict[str, Any] = {}
    """The runtime's own options; unknown ones are refused by name."""
    speed: Annotated[float, Field(gt=0, le=1000)] = 1.0
    """Of one core, beside the core for which services state ``needs.compute_ms``."""
    cost: Annotated[float, Field(ge=0, le=1_000_000)] = 0.0
    """Of one instance, in any unit that is the same for all sites; placement weighs it against delay."""
    images: tuple[Annotated[str, Field(min_length=1, max_length=255)], ...] = ("*",)
    """Patterns (``registry.example/*``) of the images that may run there."""


class Invite(Strict):
    """Let one machine join as a site."""

    name: Name
    tier: Tier = "edge"
    options: dict[str, Any] = {}
    """Of the Docker runtime, as for a site; what the machine says of its address and ports is for those that are not
    among them."""
    speed: Annotated[float, Field(gt=0, le=1000)] = 1.0
    cost: Annotated[float, Field(ge=0, le=1_000_000)] = 0.0
    images: tuple[Annotated[str, Field(min_length=1, max_length=255)], ...] = ("*",)
    ttl_s: Annotated[float, Field(ge=1, le=86_400)] = 3600.0
    """How long the join token is good for."""


class Invitation(Strict):
    """The only time that a join token is shown."""

    id: str
    name: str
    token: Annotated[str, Field(repr=False)]
    """Good once; with the SHA-256 of the public key by which the machine knows the orchestrator."""
    expires_at: datetime
    urls: tuple[str, ...] = ()
    """Where machines connect, as far as the orchestrator was told (its setting ``nodes.urls``)."""
    port: int
    """TCP port where they connect."""


class NodeState(Strict):
    """What is known of a machine that joined."""

    joined_at: datetime
    seen_at: datetime
    """When it was linked last."""
    seen_as: str
    """The address that its connections come from."""
    certificate_until: datetime
    hostname: str = ""
    system: str = ""
    architecture: str = ""
    cpu: float = 0.0
    """Cores."""
    memory_mb: int = 0
    disk_mb: int = 0
    """Free, where its engine keeps what it has."""
    engine: str = ""
    """Its version."""
    version: str = ""
    """Of Skytether there."""
    echo: int | None = None
    """UDP port of its echo for probes."""


class Unfit(Strict):
    """A service that a site failed to start, and of which it gets no more for a while."""

    service: str
    reason: str
    """How the last start ended; continues "the service ..."."""
    failures: int
    """In a row; those that were under way together count once."""
    robots: tuple[str, ...]
    """Whose instances failed, two at most; one alone: it holds for that robot only. None: for standbys only."""
    until: datetime


class Site(SiteCreate):
    """A site and what is known of it."""

    state: Literal["ready", "unreachable", "blocked"] = "ready"
    """Blocked: it answers, and what runs there runs on, but nothing can be started."""
    reason: str = ""
    """Why it is not ready."""
    isolation: tuple[str, ...] = ()
    """What holds its instances: ``own user`` (each has another) or ``user 65532`` (of all containers), ``own mounts``,
    ``own processes``, ``Landlock 7``, ``seccomp``; empty: nothing that the orchestrator knows of."""
    cpu: float | None = None
    memory_mb: int | None = None
    gpu: int | None = None
    architecture: str = ""
    load: float | None = None
    """Share of its processors that is busy."""
    instances: int = 0
    unfit: tuple[Unfit, ...] = ()
    """What it failed to start, as far as the orchestrator that leads has seen; told by that one, and to operators."""
    draining: bool = False
    """It takes no more instances, and is deleted with its last one."""
    evacuating: bool = False
    """It takes no more instances, and those that are there are moved elsewhere."""
    node: NodeState | None = None
    """Of a machine that joined; told to operators."""
