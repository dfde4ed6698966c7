"""A service's manifest: what people write in YAML. Unknown keys are refused by name."""

from __future__ import annotations

import ipaddress
import re
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

NAME = re.compile(r"[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?")
"""Names of services, sites and robots: a DNS label, so that every runtime can use them as they are."""

Name = Annotated[str, Field(pattern=rf"^{NAME.pattern}$", description="lower-case letters, digits and '-'")]
Tier = Literal["robot", "edge", "cloud"]
Device = Annotated[str, Field(pattern=r"^/dev/[A-Za-z0-9._/-]+$")]
Egress = Annotated[
    str,
    Field(
        pattern=r"^([A-Za-z0-9][A-Za-z0-9.-]{0,252}(/[0-9]{1,2})?|\[[0-9A-Fa-f:.]{2,45}(/[0-9]{1,3})?\]):[0-9]{1,5}(/(tcp|udp))?$"
    ),
]
"""HOST:PORT, of TCP, or HOST:PORT/udp; HOST is a name, an address or a network, IPv6 in brackets."""
ANY_TOPIC = "*"
RELIABLE_LIFESPAN_MS = 60_000
"""How long a reliable topic tries by default."""
ServiceGraph = Literal["ros1", "ros2"]
GRAPH_ENTRYPOINTS: dict[str, str] = {"ros1": "skytether.service.ros1", "ros2": "skytether.service.ros2"}
"""What a service with a ROS graph of its own runs, by generation."""
CALL_DEPTH = 64
"""Requests, and answers, that may be under way by default."""
ACTION_NEWEST_LIFESPAN_MS = 1000
"""Of an action's feedback and status, which come again and again."""
SHARED_TYPE = "std_msgs/msg/String"
"""Of what robots share: text that only the services understand."""
RESULT_LIFESPAN_MS = 3_600_000
"""How long an action of ROS 2 may take: its result is asked for at the start, and answered at the end."""


class Strict(BaseModel):
    """Base of everything that people or programs send us: no unknown keys, no silent changes."""

    model_config = ConfigDict(extra="forbid", frozen=True, validate_default=True, allow_inf_nan=False)


class Opening(NamedTuple):
    """One host and port that a service may connect to."""

    host: str
    port: int
    protocol: Literal["tcp", "udp"] = "tcp"

    @classmethod
    def of(cls, text: str) -> Opening:
        """From an entry of ``needs.egress``."""
        address, _, protocol = text.rpartition("/") if text.endswith(("/tcp", "/udp")) else (text, "", "tcp")
        host, _, port = address.rpartition(":")
        return cls(host.strip("[]").lower(), int(port), "udp" if protocol == "udp" else "tcp")

    def __str__(self) -> str:
        return f"{f'[{self.host}]' if ':' in self.host else self.host}:{self.port}/{self.protocol}"


class TopicSpec(Strict):
    """One topic of a service, as the service sees it; units are in the names."""

    name: Annotated[str, Field(min_length=1, max_length=255)]
    """``*`` takes any topic that the robot offers (direction ``in`` only), with this row's quality of service."""
    kind: Literal["topic", "call", "action", "ros2_action"] = "topic"
    """A call is asked in the row's direction and answered in the other; its type is that of a ROS service,
    ``nav_msgs/srv/GetPlan``. It is reliable, and ``lifespan_ms`` and ``depth`` have defaults that suit it.
    An action's goals go in the row's direction; its type is that of a ROS action, ``move_base_msgs/action/MoveBase``.
    It is carried on its five topics, the last three in the other direction: goal, cancel, result (these reliable),
    feedback and status. A ``ros2_action`` (``nav2_msgs/action/NavigateToPose``) is carried on the three calls and two
    topics that it is made of in ROS 2."""
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
    shared: bool = False
    """Between the robots of one group, not with the robot's graph: what the service says on such a topic (``out``, of
    type `SHARED_TYPE`) is told to the instances of the same service that the group's other robots have, and what those
    said comes on the other (``in``). The robots' agents carry it, by way of the orchestrator."""

    @model_validator(mode="before")
    @classmethod
    def _reliable_lives_long(cls, row: Any) -> Any:
        if not isinstance(row, dict):
            return row
        if row.get("kind") in ("call", "action", "ros2_action"):
            row = {"reliable": True, "depth": CALL_DEPTH, **row}
        return {"lifespan_ms": RELIABLE_LIFESPAN_MS, **row} if row.get("reliable") else row

    @model_validator(mode="after")
    def _reliability_fits(self) -> TopicSpec:
        if self.latched and not self.reliable:
            raise ValueError("latched: true needs reliable: true")
        if self.kind != "topic" and (not self.reliable or self.latched or self.name == ANY_TOPIC):
            raise ValueError(f"kind: {self.kind} is reliable and not latched, and has a name of its own")
        if self.kind in ("action", "ros2_action") and self.type_hash:
            raise ValueError(f"kind: {self.kind} has no type_hash: each of its topics and calls has one of its own")
        if self.shared and (self.kind != "topic" or self.type != SHARED_TYPE):
            raise ValueError(f"shared: true is for a topic of type {SHARED_TYPE}")
        return self

    def parts(self) -> tuple[TopicSpec, ...]:
        """Itself, or the calls and topics of an action of ROS 2."""
        if self.kind != "ros2_action":
            return (self,)
        call = self.model_copy(update={"kind": "call"})
        topic = self.model_copy(update={"kind": "topic", "direction": "out" if self.direction == "in" else "in"})
        newest = {"reliable": False, "depth": 1, "lifespan_ms": ACTION_NEWEST_LIFESPAN_MS}
        whole: tuple[tuple[TopicSpec, str, str, dict[str, Any]], ...] = (
            (call, "send_goal", f"{self.type}_SendGoal", {}),
            (call, "cancel_goal", "action_msgs/srv/CancelGoal", {}),
            (call, "get_result", f"{self.type}_GetResult", {"lifespan_ms": RESULT_LIFESPAN_MS}),
            (topic, "feedback", f"{self.type}_FeedbackMessage", newest),
            (topic, "status", "action_msgs/msg/GoalStatusArray", {"latched": True, "depth": 1}),
        )
        return tuple(
            spec.model_copy(update={"name": f"{self.name}/_action/{part}", "type": typ, **quality})
            for spec, part, typ, quality in whole
        )

    def rows(self) -> tuple[TopicSpec, ...]:
        """The topics that carry it: itself, the request and the response of a call, or all those of an action."""
        if self.kind == "ros2_action":
            return tuple(row for part in self.parts() for row in part.rows())
        if self.kind == "topic":
            return (self,)
        row = self.model_copy(update={"kind": "topic"})
        there, back = self.direction, "out" if self.direction == "in" else "in"
        if self.kind == "action":
            return self._action_rows(row, there, back)
        parts = (("request", "_Request", there), ("response", "_Response", back))
        return tuple(
            row.model_copy(update={"name": f"{self.name}/{part}", "type": self.type + suffix, "direction": direction})
            for part, suffix, direction in parts
        )

    def _action_rows(self, row: TopicSpec, there: str, back: str) -> tuple[TopicSpec, ...]:
        kind = self.type.replace("/action/", "/msg/")
        newest = {"reliable": False, "depth": 1, "lifespan_ms": ACTION_NEWEST_LIFESPAN_MS}
        parts: tuple[tuple[str, str, str, dict[str, Any]], ...] = (
            ("goal", f"{kind}ActionGoal", there, {}),
            ("cancel", "actionlib_msgs/msg/GoalID", there, {}),
            ("feedback", f"{kind}ActionFeedback", back, newest),
            ("result", f"{kind}ActionResult", back, {}),
            ("status", "actionlib_msgs/msg/GoalStatusArray", back, newest),
        )
        return tuple(
            row.model_copy(update={"name": f"{self.name}/{part}", "type": typ, "direction": direction, **quality})
            for part, typ, direction, quality in parts
        )

    @model_validator(mode="after")
    def _any_topic_comes_in(self) -> TopicSpec:
        if (self.name == ANY_TOPIC or self.type == ANY_TOPIC) and (self.name != self.type or self.direction != "in"):
            raise ValueError("name '*' needs type '*' and direction 'in'")
        return self


Topics = Annotated[tuple[TopicSpec, ...], Field(max_length=1000)]
"""Of one service: a robot sets each of them up, and checks it, beside driving."""


class CpuRange(Strict):
    """Between how many cores an instance may come to have."""

    min: Annotated[float, Field(gt=0, le=10_000)]
    max: Annotated[float, Field(gt=0, le=10_000)]


class MemoryRange(Strict):
    """Between how much memory [MiB] an instance may come to have."""

    min: Annotated[int, Field(gt=0, le=100_000_000)]
    max: Annotated[int, Field(gt=0, le=100_000_000)]


class Scaling(Strict):
    """Within which bounds what an instance has follows what it takes, while it runs."""

    cpu: CpuRange | None = None
    """None: its cores stay as they are."""
    memory_mb: MemoryRange | None = None
    """None: its memory stays as it is."""
    step_ms: Annotated[float, Field(gt=0, le=60_000)] | None = None
    """Of 20 steps of the service 19 are to take no longer; else it gets more cores. None: its load alone counts."""

    @model_validator(mode="after")
    def _is_between_something(self) -> Scaling:
        for key in ("cpu", "memory_mb"):
            range_ = getattr(self, key)
            if range_ is not None and range_.min > range_.max:
                raise ValueError(f"scaling.{key}: min is {range_.min:g}, above max, {range_.max:g}")
        if self.cpu is None and self.memory_mb is None:
            raise ValueError("scaling: say what follows the load, cpu or memory_mb, each with min and max")
        if self.step_ms is not None and self.cpu is None:
            raise ValueError("scaling.step_ms: longer steps get more cores: say with scaling.cpu how many")
        return self


class Needs(Strict):
    """What a site and a link must offer before an instance may run there."""

    cpu: Annotated[float, Field(gt=0)] = 0.1
    """Cores."""
    memory_mb: Annotated[int, Field(gt=0)] = 128
    scaling: Scaling | None = None
    """Both are what an instance begins with, and follow what it takes; None: it keeps what it has."""
    gpu: Annotated[int, Field(ge=0)] = 0
    compute_ms: Annotated[float, Field(gt=0, le=60_000)] = 5.0
    """One step of the service on a core of its own; placement reckons delay with it."""
    architectures: tuple[Annotated[str, Field(pattern=r"^[a-z0-9_]+$")], ...] = ()
    """As container images name them (``amd64``, ``arm64``); empty: any."""
    devices: tuple[Device, ...] = ()
    """Device files, ``/dev/video0``; a container site must offer each."""
    egress: Annotated[tuple[Egress, ...], Field(max_length=64)] = ()
    """What it may connect to, HOST:PORT[/udp]; all else is closed, at a container site, which must offer each. A name's
    addresses are looked up at each start, and in the container's hosts file."""
    max_rtt_ms: Annotated[float, Field(gt=0)] | None = None
    """Above this the robot's fallback takes over; None: any."""
    max_loss: Annotated[float, Field(ge=0, le=1)] | None = None
    """Share of messages; above this the robot's fallback takes over; None: any."""
    standby: Annotated[int, Field(ge=0, le=100)] = 0
    """Instances that are kept running for nobody, with the parameters that were asked for last: a request that has
    the same ones gets one of them at once, and so does a robot whose instance fails."""
    tiers: Annotated[tuple[Tier, ...], Field(min_length=1)] = ("robot", "edge", "cloud")

    @field_validator("egress")
    @classmethod
    def _egress_can_be_opened(cls, egress: tuple[str, ...]) -> tuple[str, ...]:
        for text in egress:
            opening = Opening.of(text)
            if not 0 < opening.port < 65_536:
                raise ValueError(f"'{text}': a port is 1 to 65535")
            if "/" in opening.host or ":" in opening.host:
                try:
                    ipaddress.ip_network(opening.host, strict=False)
                except ValueError as error:
                    raise ValueError(f"'{text}': {error}") from None
        return egress

    @model_validator(mode="after")
    def _begins_within_its_scaling(self) -> Needs:
        for key in ("cpu", "memory_mb"):
            range_, begins = getattr(self.scaling, key, None), getattr(self, key)
            if range_ is not None and not range_.min <= begins <= range_.max:
                raise ValueError(f"{key} is {begins:g}, and scaling.{key} goes from {range_.min:g} to {range_.max:g}")
        return self

    @property
    def openings(self) -> tuple[Opening, ...]:
        return tuple(dict.fromkeys(map(Opening.of, self.egress)))


class Limits(Strict):
    """What a container may take at most; of a process with a user of its own, ``pids`` alone."""

    cpu: Annotated[float, Field(gt=0)] | None = None
    """Cores; None: one, or what it needs if that is more. Below that, its share is by need."""
    memory_mb: Annotated[int, Field(gt=0)] | None = None
    """Beyond it the service is killed; None: what it needs."""
    pids: Annotated[int, Field(ge=8, le=32_768)] = 256
    """Processes and threads."""


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
    graph: ServiceGraph | None = None
    """``ros1`` or ``ros2``: a ROS graph of its own, with unchanged nodes: ``launch`` says which. The entry point is
    then ``skytether.service.ros1`` (or ``ros2``) unless another is named, and the image one made on
    ``skytether/ros1-base`` (or ``ros2-base``)."""
    launch: Annotated[str, Field(min_length=1, max_length=1024)] | None = None
    """Launch file of the graph: an absolute path where the service runs, or ``package/file.launch``. Of ROS 2 also a
    program that is no launch file: a path, or ``package/program``."""
    remap: dict[str, str] = {}
    """Names in the graph of the service's topics, calls and actions, where they are not those of its namespaces."""
    params: dict[str, Any] = {}
    """JSON schema (2020-12) of the parameters; ``additionalProperties`` is false unless it says otherwise."""
    topics: Topics = ()
    states: Annotated[tuple[Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,62}$")], ...], Field(max_length=32)] = ()
    """Codes of its reports that tell in which state it is: the last one reported is a metric."""
    needs: Needs = Needs()
    limits: Limits = Limits()

    @model_validator(mode="after")
    def _limits_allow_the_needs(self) -> ServiceSpec:
        for key in ("cpu", "memory_mb"):
            limit, need = getattr(self.limits, key), getattr(self.needs, key)
            if limit is not None and limit < need:
                raise ValueError(f"limits.{key} is {limit:g}, less than needs.{key}, {need:g}")
            range_ = getattr(self.needs.scaling, key, None)
            if limit is not None and range_ is not None and limit < range_.max:
                raise ValueError(f"limits.{key} is {limit:g}, less than needs.scaling.{key}.max, {range_.max:g}")
        return self

    @model_validator(mode="before")
    @classmethod
    def _graphs_have_an_entry_point(cls, spec: Any) -> Any:
        if not isinstance(spec, dict) or spec.get("entrypoint"):
            return spec
        entrypoint = GRAPH_ENTRYPOINTS.get(str(spec.get("graph")))
        return {**spec, "entrypoint": entrypoint} if entrypoint else spec

    @model_validator(mode="after")
    def _graph_is_whole(self) -> ServiceSpec:
        if self.graph is not None and self.launch is None:
            raise ValueError(f"graph: {self.graph} needs launch: the launch file with the service's nodes")
        if self.graph is None and (self.launch is not None or self.remap):
            raise ValueError("launch and remap are for a service with a graph of its own; add graph: ros1 or ros2")
        for topic in self.topics:
            if self.graph == "ros2" and topic.kind == "action":
                raise ValueError(
                    f"'{topic.name}': kind: action is an action of ROS 1; one of graph: ros2 is ros2_action"
                )
        known = {t.name for t in self.topics}
        for name in self.remap:
            if name not in known and ANY_TOPIC not in known:
                raise ValueError(f"remap: the service has no topic '{name}'")
        return self

    @model_validator(mode="after")
    def _can_run_and_names_are_unique(self) -> ServiceSpec:
        if not self.image and not self.entrypoint:
            raise ValueError("one of 'image' and 'entrypoint' is needed")
        names = [t.name for t in self.topics]
        for what, listed in (("topic", names), ("state", list(self.states))):
            for name in listed:
                if listed.count(name) > 1:
                    raise ValueError(f"{what} '{name}' is listed twice")
        for direction in ("in", "out"):
            shared = [t.name for t in self.topics if t.shared and t.direction == direction]
            if len(shared) > 1:
                raise ValueError(f"'{shared[0]}' and '{shared[1]}': one topic of each direction may be shared")
        return self

    def sized(self, cpu: float, memory_mb: int) -> ServiceSpec:
        """The same with other needs of cores and memory [MiB]; limits below them are raised to them."""
        needs = self.needs.model_copy(update={"cpu": cpu, "memory_mb": memory_mb})
        raised = {
            key: need
            for key, need in (("cpu", cpu), ("memory_mb", memory_mb))
            if (limit := getattr(self.limits, key)) is not None and limit < need
        }
        return self.model_copy(update={"needs": needs, "limits": self.limits.model_copy(update=raised)})

    def typed(self, params: dict[str, Any]) -> dict[str, Any]:
        """The parameters as the service's graph takes them: for ROS 2, 2 is no number with a fraction, but 2.0 is."""
        return _typed(self.params, params) if self.graph == "ros2" else params

    @property
    def robot_topics(self) -> Topics:
        """Those between the service and its robot's graph."""
        return tuple(topic for topic in self.topics if not topic.shared)

    def shared(self, direction: Literal["in", "out"]) -> str | None:
        """The topic of this direction that is shared between robots; None: there is none."""
        return next((t.name for t in self.topics if t.shared and t.direction == direction), None)


def _typed(schema: Any, value: Any) -> Any:
    """A value, with whole numbers made floats wherever its schema says ``number``."""
    schema = schema if isinstance(schema, dict) else {}
    if isinstance(value, dict):
        properties = schema.get("properties")
        known = properties if isinstance(properties, dict) else {}
        return {name: _typed(known.get(name), inner) for name, inner in value.items()}
    if isinstance(value, list):
        return [_typed(schema.get("items"), inner) for inner in value]
    whole = type(value) is int and abs(value) < 2**63  # what is larger is no value of ROS 2
    return float(value) if whole and schema.get("type") == "number" else value


class Manifest(Strict):
    """The whole document."""

    api_version: Annotated[Literal["skytether.io/v1"], Field(alias="apiVersion")]
    kind: Literal["Service"]
    metadata: Metadata
    spec: ServiceSpec
