"""What goes over REST, both ways. Times are RFC 3339 in UTC."""

from __future__ import annotations

import re
from datetime import datetime
from enum import StrEnum
from typing import Annotated, Any, Literal, get_args

from pydantic import AfterValidator, BeforeValidator, FailFast, Field, model_validator

from .manifest import Name, Needs, Strict, Tier, Topics
from .pull_progress import PullProgress


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


class Change(StrEnum):
    """What a document that was put did, in the header ``Skytether-Change`` of the answer."""

    CREATED = "created"
    CHANGED = "changed"
    UNCHANGED = "unchanged"


CHANGE = "Skytether-Change"
PATH_NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")
"""What can stand for something in a path: names and ids; never a part of a path, a query, or a control character."""


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


def _between(least: float, most: float) -> BeforeValidator:
    """A number outside is taken as not measured: a broken sensor is not to cost the robot its lease."""

    def plausible(value: object) -> object:
        number = isinstance(value, int | float) and not isinstance(value, bool)
        return value if not number or least <= value <= most else None  # type: ignore[operator]

    return BeforeValidator(plausible)


_Share = Annotated[float | None, _between(0, 1)]
_Duration = Annotated[float | None, _between(0, 3600)]
_Delay = Annotated[float | None, _between(-10, 3600)]
"""One way; as wrong as the clocks of both ends are, and so perhaps negative."""
MOST_COUNTED = 10**15
"""A counter's largest value: in bytes 4 MB/s for eight years. Sums of many such are exact in a double."""
MOST_TOPICS = 1024
"""In a report. Beside those of a service there is room for some of the one before it."""
_Count = Annotated[int, Field(ge=0, le=MOST_COUNTED)]
_Counts = Annotated[dict[Annotated[str, Field(max_length=64)], _Count], Field(max_length=64)]
"""By reasons, of which there are few."""


class TopicReport(Strict):
    """One topic's quality as the robot knows it. Counters only go up while the report's ``life`` is the same."""

    topic: Annotated[str, Field(max_length=255)]
    direction: Literal["in", "out"]
    priority: Annotated[int, Field(ge=0, le=127)]
    sent: _Count = 0
    delivered: _Count = 0
    lost: _Count = 0
    """Those that came late after all included: when nothing is under way any more,
    ``sent == delivered + superseded + lost - late + unknown``."""
    late: _Count = 0
    unknown: _Count = 0
    """Sent to a service before it was restarted, which had not said what became of them, or under way when their
    session ended."""
    expired: _Count = 0
    replaced: _Count = 0
    superseded: _Count = 0
    duplicate: _Count = 0
    bytes_sent: _Count = 0
    delay_p50_s: _Delay = None
    """Delays and jitter are those of the present session."""
    delay_p99_s: _Delay = None
    jitter_s: _Duration = None


class GateReport(Strict):
    """The gate before the robot's wheels, as the agent beside it sees it."""

    answers: bool = False
    stopped: Annotated[str, Field(max_length=200)] = ""
    """Why the robot stands until a person beside it resets it; empty: it does not."""
    hand: Annotated[str, Field(max_length=32)] = ""
    """Who drives, as the gate says: ``agent``, ``joystick``, another source, or ``nobody``."""
    zone: Annotated[str, Field(max_length=32)] = ""
    """What lies ahead: ``free``, ``slow``, ``stop`` or ``unknown``."""
    troubles: Annotated[int, Field(ge=0, le=10_000)] = 0
    """Sentences that the gate has to say about what is wrong now."""


class Report(Strict):
    """What the robot tells the orchestrator with each renewal; it feeds /metrics."""

    life: Annotated[str, Field(max_length=64)] = ""
    """Which counting it is of: another one begins at zero, and adds to what was counted before. Made up anew at each
    start of the robot's program; under the same one counters go on over all its sessions with a service."""
    rtt_s: _Duration = None
    # Up to the first fault only: 180,000 of them, in a body that a robot may send, took a second to find and tell.
    topics: Annotated[tuple[TopicReport, ...], Field(max_length=MOST_TOPICS), FailFast()] = ()
    control_source: Annotated[str, Field(max_length=16)] | None = None
    """Who drives: ``cloud``, ``fallback`` or ``stop``."""
    fallback_transitions: _Counts = {}
    """Counted by bounded reason."""
    objections: _Counts = {}
    """What the velocity supervisor found wrong with commands, counted by bounded kind."""
    load: _Share = None
    """Share of the robot's processors that is busy."""
    battery: _Share = None
    """Charge, 0 to 1."""
    overruns: _Count | None = None
    """Ticks of the control loop that came more than a period late."""
    gate: GateReport | None = None
    """None: the robot's wheels are behind no gate."""


class Migrate(Strict):
    """Move an instance: another one is started, and its robot changes to that once it runs."""

    site: Name | None = None
    """Where to; None: the best of the other sites."""


class Renew(Strict):
    """Keep the lease; optionally report."""

    measurements: Measurements = {}
    """What was measured since, instead of what was told before."""

    lease_s: Annotated[float, Field(ge=1, le=86_400)] | None = None
    report: Report | None = None


MOST_SHARED = 8192
"""Bytes of UTF-8 that a service may share at a time; with them a robot's request counts as one or two."""
_UNSHARED = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff]")
"""Six times as long in JSON. Without them what 15 robots say is at most twice 15 times `MOST_SHARED` there."""
MOST_NEIGHBOURS = 15
"""Robots of a group whose words one of them gets: those heard last."""


def unshareable(text: str) -> str | None:
    """Why a text cannot be shared between robots; None: it can."""
    if (size := len(text.encode(errors="surrogatepass"))) > MOST_SHARED:
        return f"it has {size} bytes, and {MOST_SHARED} at most are carried"
    if _UNSHARED.search(text):
        return "it has control characters, of which only tabs and ends of lines are carried"
    return None


def _shareable(text: str) -> str:
    if why := unshareable(text):
        raise ValueError(why)
    return text


class Share(Strict):
    """What an instance's service shares, and what it hears for it."""

    text: Annotated[str, Field(max_length=MOST_SHARED), AfterValidator(_shareable)] | None = None
    """Instead of what it said before; None: nothing new."""
    age_s: Annotated[float, Field(ge=0, le=3600)] = 0.0
    """How long ago the robot got it of its service."""


class Shared(Strict):
    """What the same service of another robot of the group said last."""

    robot: str
    age_s: float
    """How long ago it did, but for the way to its robot and from there."""
    text: str


class Neighbours(Strict):
    """What a robot's neighbours share with it."""

    group: str | None = None
    """The robot's; None: it is in none, and nothing is kept of what it said."""
    others: tuple[Shared, ...] = ()


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


TokenLife = Annotated[float, Field(ge=1, le=10 * 365 * 86_400)]
"""Seconds that a token is good for."""


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


Scope = Literal["read", "instances", "sessions", "catalog", "sites", "robots", "tokens", "metrics"]
"""What an operator's token may: see everything but keys; change instances; get the keys of sessions (and so speak as a
robot or its service); change catalog, sites, robots, tokens; read /metrics."""
SCOPES: tuple[Scope, ...] = get_args(Scope)


class TokenCreate(Strict):
    """Another token: a robot's, or an operator's with some scopes."""

    name: Name
    """For people, to tell it from others: no two of a robot, or of operators, have the same."""
    robot: Name | None = None
    scopes: tuple[Scope, ...] = ()
    ttl_s: TokenLife | None = None
    """How long it is good for; None: until it is deleted."""


class TokenRotate(Strict):
    """Another token instead of one."""

    grace_s: Annotated[float, Field(ge=0, le=30 * 86_400)] = 300
    """How long the old one is good for still."""
    ttl_s: TokenLife | None = None
    """How long the new one is good for, for who may make such tokens; None: until the end of the old one."""


class Token(Strict):
    """What is known of a token; never the token itself."""

    id: str
    name: str
    robot: str | None = None
    scopes: tuple[Scope, ...] = ()
    family: str = ""
    """The same for a token and the one that it was renewed by."""
    created_at: datetime
    expires_at: datetime | None = None
    last_used_at: datetime | None = None


class TokenCreated(Token):
    """The only time that the token is shown."""

    token: Annotated[str, Field(repr=False)]


class ScrapeTargets(Strict):
    """One group of Prometheus' HTTP service discovery."""

    targets: tuple[str, ...]
    """``HOST:PORT`` of each."""
    labels: dict[str, str] = {}
    """What all of them get; ``__scheme__`` says how they are asked."""


class Problem(Strict):
    """RFC 9457 problem document."""

    type: str = "about:blank"
    title: str
    status: int
    detail: str = ""
    """One sentence with what to do."""
    instance: str | None = None
    errors: tuple[dict[str, Any], ...] = ()
    """For invalid input: ``{"key": "spec.topics.0.prority", "detail": "unknown key"}``."""
