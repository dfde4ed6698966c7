"""The configuration of ``skytether robot run``: what people write in robot.yaml."""

from __future__ import annotations

import difflib
import os
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, field_validator, model_validator

from skytether.api.config_file import ConfigError, Endpoint, read_config
from skytether.api.document_checks import oddity
from skytether.api.manifest import Name, Strict
from skytether.api.plain_http import is_readable_on_the_way
from skytether.bridge.local_network import LocalNetwork
from skytether.robot.agent.status import DEFAULT_PORT
from skytether.robot.config_base import no_switches
from skytether.robot.control.arbiter import LinkRequirements
from skytether.robot.control.supervisor import VelocityLimits
from skytether.robot.graphs.graph_base import protected_names as graph_names
from skytether.robot.graphs.graph_config import RobotGraphConfig
from skytether.robot.graphs.kind import GateSection, GraphKind, RobotSection
from skytether.robot.graphs.registry import GRAPHS, sections_of, with_sections
from skytether.robot.offload.task_manager import Mode, Policy
from skytether.robot.safety.config.bounds import LONGEST_REASON, check_plausible
from skytether.robot.safety.config.protected import protected_names as safety_names
from skytether.robot.safety.config.safety_config import NO_GATE, WITHOUT_SECTION, SafetyConfig
from skytether.ros.names import Names, check_name, namespace_of, resolve
from skytether.ros.permissions import Access, Allowed, Permissions
from skytether.ros.ros1.arguments import RosArguments


def _plain(values: dict[str, Any]) -> dict[str, Any]:
    fault = oddity(values)
    if fault is not None:
        raise ValueError(str(fault))
    return values


PlainValues = Annotated[dict[str, Any], AfterValidator(_plain)]
Weight = Annotated[float, Field(ge=0, le=1e6)]
_POLICY = Policy()


class FallbackConfig(Strict):
    """The robot's own controller."""

    name: Annotated[str, Field(min_length=1)] = "stop"
    """Entry point of the group ``skytether.fallbacks``."""
    options: PlainValues = {}


class LinkNeeds(Strict):
    """What the link must be like while the service drives; a service's manifest only tightens it."""

    max_rtt_ms: Annotated[float, Field(gt=0, le=5000)] = 1000.0
    """Round trip. What drives the robot was made from information that is at most so old, and ``limits.max_gap_s``."""
    max_loss: Annotated[float, Field(ge=0, le=0.95)] = 0.5
    """Share of a topic's messages that may be lost."""
    max_late: Annotated[float, Field(ge=0, le=0.95)] = 0.5
    """Share of a topic's messages that may come too late to be used."""

    def needs(self) -> LinkRequirements:
        """For the source choice."""
        return LinkRequirements(max_rtt_s=self.max_rtt_ms / 1000, max_loss=self.max_loss, max_late=self.max_late)


class CloudConfig(Strict):
    """What the service may do in the robot's graph, beyond names below its own namespace.

    Names are absolute, or in the robot's namespace; each includes all below it. What safety reads, what the robot's own
    controller reads, ``/clock`` and what the wheels listen to is never the cloud's, and cannot be listed.
    """

    publish: tuple[str, ...] = ()
    """Topics, and actions of ROS 1 whose goals the service sends: ``[/tf, /move_base]``."""
    call: tuple[str, ...] = ()
    """Services of the robot's nodes that it may call, and actions of ROS 2 whose goals it sends. Services that change a
    node (``set_parameters`` and the like) must be listed in full."""
    offer: tuple[str, ...] = ()
    """Services that the robot's nodes may call at it."""


class TaskConfig(Strict):
    """Local or offloaded, and to which site: weights and hysteresis of `offload.task_manager.Policy`."""

    mode: Literal["auto", "offload", "local"] = "auto"
    """``offload``: the service is asked for, always; ``local``: never; ``auto``: the costs decide."""
    echoes: dict[Name, Annotated[str, Field(pattern=r"^.+:\d{1,5}$", description="HOST:PORT")]] = {}
    """``skytether echo`` of sites, by site; the others are probed through the orchestrator."""
    probe_s: Annotated[float, Field(ge=0.1, le=3600)] = 1.0
    """Between two probes of each site."""
    delay: Weight = _POLICY.delay
    loss: Weight = _POLICY.loss
    energy: Weight = _POLICY.energy
    processor: Weight = _POLICY.processor
    service: Weight = _POLICY.service
    radio: Weight = _POLICY.radio
    local_cpu: Weight = _POLICY.local_cpu
    margin: Weight = _POLICY.margin
    hold_s: Weight = _POLICY.hold_s
    bad_s: Weight = _POLICY.bad_s

    @property
    def addresses(self) -> dict[str, tuple[str, int]]:
        """The echoes, taken apart."""
        parted = ((site, echo.rpartition(":")) for site, echo in self.echoes.items())
        return {site: (host.strip("[]"), int(port)) for site, (host, _, port) in parted}

    def policy(self) -> Policy:
        """For the task manager."""
        return Policy(**{**self.model_dump(exclude={"echoes", "probe_s"}), "mode": Mode(self.mode)})


@with_sections(lambda kind: kind.section)
class RobotConfig(Strict):
    """The whole file. `with_sections` adds a key for each kind of graph: the robot is one of them."""

    robot: Name
    """As it is registered: ``skytether robot add NAME``."""
    orchestrator: Annotated[str, Field(pattern=r"^https?://", description="https://HOST:PORT; several with commas")]
    insecure_http: bool = False
    """``http://`` beyond this machine too: whoever is on the way reads token and keys of sessions."""
    token_file: Path
    """Holds the token that the registration printed; relative to this file's folder."""
    service: Name
    params: PlainValues = {}
    """The service's."""
    command_topic: Annotated[str, Field(min_length=1)] = "cmd_vel"
    """The service's topic that drives the robot (geometry_msgs/msg/Twist)."""
    fallback: FallbackConfig = FallbackConfig()
    limits: dict[str, float] = {}
    """What the wheels may do: fields of ``skytether.robot.control.supervisor.VelocityLimits``."""
    beyond: dict[str, Annotated[str, Field(min_length=1, max_length=LONGEST_REASON)]] = {}
    """Limits that are meant to be beyond what is plausible: ``limits.NAME`` to reason."""
    needs: LinkNeeds = LinkNeeds()
    """What the link must be like at least."""
    rate_hz: Annotated[float, Field(ge=1, le=1000)] = 100.0
    """Of the robot's control loop."""
    bind: Endpoint = Endpoint(host="0.0.0.0")  # noqa: S104 - a robot has one network or several
    paths: Literal["auto"] | tuple[LocalNetwork, ...] = ()
    """Networks that the bridge uses side by side; ``auto``: all that lead out of this machine. Empty: ``bind``."""
    ca_file: Path | None = None
    """PEM file of the certificate's authority; in the file, relative to its folder; null: the system's."""
    task: TaskConfig = TaskConfig()
    status_port: Annotated[int, Field(ge=0, le=65_535)] | None = DEFAULT_PORT
    """Of ``/status`` and ``/metrics`` on loopback, the next if it is taken; 0: any free one; null: there are none."""
    safety: SafetyConfig | None = Field(default_factory=lambda: SafetyConfig.model_validate(WITHOUT_SECTION))
    """The gate's part (``skytether robot gate``): velocities go to the gate and not to the wheels.

    Without the key, a gate that knows limits and silence only; ``none``: no gate."""
    cloud: CloudConfig = CloudConfig()
    """What the service may publish, call and offer in the robot's graph."""

    @field_validator("fallback", mode="before")
    @classmethod
    def _name_alone(cls, value: Any) -> Any:
        return {"name": value} if isinstance(value, str) else value

    @field_validator("safety", mode="before")
    @classmethod
    def _section_or_none(cls, value: Any) -> Any:
        if value is None:
            raise ValueError("is empty: write the gate's section, or none for no gate, or leave the key away")
        return None if value == NO_GATE else value

    @property
    def gate_is_assumed(self) -> bool:
        """Whether there is to be a gate that nobody has configured."""
        return "safety" not in self.model_fields_set

    @field_validator("limits", mode="before")
    @classmethod
    def _are_numbers(cls, limits: Any) -> Any:
        return no_switches(limits)

    @field_validator("limits")
    @classmethod
    def _they_limit(cls, limits: dict[str, float]) -> dict[str, float]:
        known = [f.name for f in fields(VelocityLimits)]
        for name in limits:
            if name not in known:
                near = difflib.get_close_matches(name, known, n=1)
                guess = f", did you mean {near[0]!r}?" if near else ""
                raise ValueError(f"{name}: unknown key{guess}; allowed are {', '.join(known)}")
        try:
            VelocityLimits(**limits)
        except ValueError as error:
            raise ValueError(str(error).removeprefix("limits: ")) from None
        return limits

    @model_validator(mode="after")
    def _is_plausible(self) -> RobotConfig:
        self.notes()
        return self

    def notes(self) -> tuple[str, ...]:
        """A sentence for each of the limits that is beyond its bounds."""
        return check_plausible({"limits": self.limits}, self.beyond, "beyond")

    @model_validator(mode="after")
    def _token_stays_secret(self) -> RobotConfig:
        readable = [url for url in self.orchestrator.split(",") if is_readable_on_the_way(url)]
        if readable and not self.insecure_http:
            raise ValueError(
                f"orchestrator: {readable[0].strip()} is plain http, and the token could be read on the way: write "
                "https://; inside a network that is all yours, such as a VPN, add insecure_http: true"
            )
        return self

    @model_validator(mode="after")
    def _has_a_graph(self) -> RobotConfig:
        found = sections_of(self)
        if len(found) != 1:
            first, *others = found or GRAPHS
            fault = f"stands beside {' and '.join(others)}" if found else "is missing"
            others = [key for key in GRAPHS if key != first]
            raise ValueError(
                f"{first}: {fault}; it, or {' or '.join(others)}, says which graph the robot is (an empty one is "
                f"written: {first}: {{}})"
            )
        return self

    @model_validator(mode="after")
    def _the_cloud_has_no_way_past_safety(self) -> RobotConfig:
        ros = self.kind.generation
        permissions = Permissions(self.home, namespace_of(self.service), Allowed(), self.protected)
        for access in Access:
            for i, given in enumerate(getattr(self.cloud, access)):
                key = f"cloud.{access}.{i}"
                try:
                    name = check_name(resolve(check_name(given, ros), self.home), ros)
                except ValueError as error:
                    raise ValueError(f"{key}: {error}") from None
                why = permissions.protected(name)
                if why:
                    raise ValueError(f"{key}: {name} is never the cloud's: {why}; take it out of the list")
        return self

    @property
    def kind(self) -> GraphKind[Any, Any]:
        """Of the robot's graph."""
        return next(GRAPHS[key] for key in sections_of(self))

    @property
    def graph(self) -> RobotSection:
        """The robot's graph: the section of its kind."""
        section: RobotSection = next(iter(sections_of(self).values()))
        return section

    @property
    def graph_config(self) -> RobotGraphConfig:
        """What a graph of any kind needs of the file."""
        graph = self.graph
        return RobotGraphConfig(
            robot=self.robot,
            service=self.service,
            namespace=graph.namespace,
            remap=graph.remap,
            cmd_vel=graph.cmd_vel if self.safety is None else None,
            idle_s=graph.idle_s,
            fresh_s=VelocityLimits(**self.limits).watchdog_s,
            readings=graph.readings,
            topics=graph.topics,
            allowed=self.allowed,
            protected=self.protected,
            wheels=self.wheels,
            drivers=self.drivers,
        )

    @property
    def home(self) -> str:
        """The namespace of the robot's topics."""
        given = self.graph.namespace
        return namespace_of(self.robot) if given is None else resolve(given, "/")

    @property
    def wheels(self) -> str | None:
        """Absolute name of what the wheels listen to; None: it is no topic of the robot's graph."""
        if self.safety is not None and self.safety.sockets is not None:
            return None
        if self.safety is None:
            return self.kind.wheels(self._names, self.home, self.graph.cmd_vel)
        way = self._way
        namespace = way.namespace if way is not None and "namespace" in way.model_fields_set else self.home
        own = way.cmd_vel if way is not None and "cmd_vel" in way.model_fields_set else self.graph.cmd_vel
        return resolve(own, namespace)

    @property
    def drivers(self) -> tuple[str, ...]:
        """Names of the gate's nodes that publish it; empty: there is no gate."""
        way = self._way
        if self.safety is None:
            return ()
        node = way.node if way is not None and "node" in way.model_fields_set else self.graph.node
        namespace = way.namespace if way is not None and "namespace" in way.model_fields_set else self.home
        return tuple(resolve(f"{node}_{role}", namespace) for role in ("guard", "gate"))

    @property
    def _way(self) -> GateSection | None:
        return None if self.safety is None else getattr(self.safety, self.kind.key)

    @property
    def _names(self) -> Names:
        return Names((), self.home, "/", self.graph.remap, ros=self.kind.generation)

    @property
    def allowed(self) -> Allowed:
        """What is listed for the service, by absolute names."""
        lists = ([resolve(name, self.home) for name in getattr(self.cloud, access)] for access in Access)
        return Allowed(*lists)

    @property
    def protected(self) -> dict[str, str]:
        """What is never the service's: why, by absolute name."""
        found = graph_names(self._names, self.home, [self.graph.cmd_vel], self.graph.readings)
        if self.safety is None:
            return found
        return found | safety_names(self.safety, self.home, self.kind.prefix(self.graph))


def load_config(path: Path, ros: RosArguments | None = None) -> RobotConfig:
    """Read and check a robot.yaml.

    Args:
        path: The file.
        ros: What ROS gave on the command line, which counts more than the file.

    Raises:
        ConfigError: It cannot be read, is no YAML, or a key is wrong.
    """
    settings = read_config(path, RobotConfig, (ros or RosArguments()).over)
    if settings.ca_file is None:
        return settings
    return settings.model_copy(update={"ca_file": path.parent / settings.ca_file})


def load_token(settings: RobotConfig, folder: Path) -> str:
    """Read the robot's token.

    Args:
        settings: Name the file.
        folder: That its path is relative to.

    Raises:
        ConfigError: It is missing, empty, open to others, or no text.
    """
    path = folder / settings.token_file
    try:
        with path.open("rb") as file:
            others = os.fstat(file.fileno()).st_mode & 0o077
            token = file.read(4096).decode("ascii").strip()
    except OSError as error:
        raise ConfigError(
            f"cannot read token_file {path}: {error.strerror}; register the robot with: skytether robot add "
            f"{settings.robot} > {path}"
        ) from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"token_file {path} holds no token but other bytes") from error
    if others:
        raise ConfigError(f"token_file {path} is open to other users; close it with: chmod 600 {path}")
    if not token:
        raise ConfigError(f"token_file {path} is empty; it must hold the token that 'skytether robot add' printed")
    return token
