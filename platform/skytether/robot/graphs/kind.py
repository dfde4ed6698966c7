"""What a kind of robot graph is: what is written of it in robot.yaml, and how agent, gate and --check reach it.

A new kind is one file or folder here: its two sections and a `GraphKind`, and a row of the table in `registry`. The
configuration, the command line, the gate's processes and the doctor ask the table, and name no kind themselves.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Generic, Literal, TypeVar

from pydantic import Field, field_validator

from skytether.api.manifest import Manifest, Strict
from skytether.guard.board import Place
from skytether.messages import Encoding, type_of
from skytether.ros.names import Generation, Names, check_name, resolve

from ..config_base import Numbers, Topic

if TYPE_CHECKING:  # the gate's processes load none of what these need
    from skytether.ros.ros1.arguments import RosArguments

    from .finding import Finding
    from .gate_io import Display, Sensors, Wheels, WheelsTiming
    from .graph_base import RobotGraph
    from .graph_config import RobotGraphConfig
    from .inbox import Topics


class RobotSection(Strict):
    """What robot.yaml says of the robot's graph, of whatever kind. Names: absolute, or in ``namespace``."""

    namespace: str | None = None
    """Where the robot's topics are; null: under the robot's name."""
    node: Annotated[str, Field(min_length=1)] = "skytether"
    """Name of the agent's node, where a graph has such."""
    remap: dict[str, str] = {}
    """The graph's names of the service's topics, calls and actions, of ``cmd_vel`` and of the readings."""
    cmd_vel: Annotated[str, Field(min_length=1)] = "cmd_vel"
    """What the wheels listen to."""
    idle_s: Annotated[float, Field(gt=0)] | None = 1.0
    """Seconds that a standstill is told before ``cmd_vel`` is left to others; null: for ever."""
    readings: dict[str, str] = {}
    """What the robot's own control reads, name to type: ``{force: geometry_msgs/msg/WrenchStamped}``."""
    topics: tuple[str, ...] = ()
    """What is sent to a service that takes any topic, such as the recorder."""

    @field_validator("readings")
    @classmethod
    def _known_types(cls, readings: dict[str, str]) -> dict[str, str]:
        for name, kind in readings.items():
            try:
                type_of(kind)
            except KeyError as error:
                raise ValueError(f"{name}: {error.args[0]}") from None
        return readings

    def check_names(self, ros: Generation) -> None:
        """Refuse what this generation refuses.

        Raises:
            ValueError: The text names the key.
        """
        named = {"namespace": self.namespace, "cmd_vel": self.cmd_vel}
        named.update({f"remap.{key}": value for key, value in self.remap.items()})
        named.update({f"topics.{i}": value for i, value in enumerate(self.topics)})
        for key, value in named.items():
            try:
                if value is not None:
                    check_name(value, ros)
            except ValueError as error:
                raise ValueError(f"{key}: {error}") from None


class GateSection(Numbers):
    """What the section ``safety`` says of the same graph: what it does not say is taken from the robot's."""

    namespace: str = "/"
    """Where relative names are."""
    node: Topic = "skytether"
    """The gate's nodes are called so with ``_guard``, ``_gate``, ``_sensors`` and ``_display`` after it."""
    cmd_vel: Topic = "cmd_vel"
    """What the wheels listen to; nobody else may publish it."""
    wheels_nodes: tuple[Topic, ...] = ()
    """Nodes that turn the wheels, where they are known: others listen to ``cmd_vel``, come and go, and it is no
    reason to stand. Empty: whoever listens may be one."""


Section = TypeVar("Section", bound=RobotSection)
Way = TypeVar("Way", bound=GateSection)
Role = Literal["guard", "gate"]


class GraphKind(ABC, Generic[Section, Way]):
    """One kind. What opens something raises OSError for the gate, ConfigError for the agent, if it cannot be had."""

    key: ClassVar[str]
    """Of its sections, in robot.yaml and below ``safety``."""
    generation: ClassVar[Generation] = 2
    """Of ROS, whose rules names obey."""
    encoding: ClassVar[Encoding] = "cdr"
    """Of all that goes through the graph."""
    remaps_wheels: ClassVar[bool] = True
    """Whether ``remap`` counts for ``cmd_vel`` where there is no gate."""
    todo: ClassVar[str] = "correct the robot's graph in robot.yaml"
    """What mends a graph that cannot be joined, for the doctor."""
    section: type[Section]
    gate_section: type[Way]

    # The agent's part.

    @abstractmethod
    def join(
        self,
        section: Section,
        config: RobotGraphConfig,
        folder: Path,
        ros: RosArguments,
        on_end: Callable[[str], None],
    ) -> AbstractContextManager[RobotGraph]:
        """The robot's graph for the agent, for as long as the context lasts.

        Args:
            section: Of robot.yaml.
            config: What all kinds have, and what follows from other parts of the file.
            folder: That paths are relative to.
            ros: What ROS gave on the command line.
            on_end: Told a reason when the graph wants the agent to end.

        Raises:
            ConfigError: It cannot be joined.
        """

    @abstractmethod
    def check(
        self,
        section: Section,
        config: RobotGraphConfig,
        folder: Path,
        *,
        manifest: Manifest | None,
        command_topic: str,
        role: str,
    ) -> list[Finding]:
        """What ``--check`` and the doctor find in it, the graph itself first.

        Args:
            section: Of robot.yaml.
            config: As of `join`.
            folder: That paths are relative to.
            manifest: The service's; None: not known.
            command_topic: That drives the robot.
            role: Who looks: an agent may run meanwhile.

        Raises:
            ConfigError: It cannot be joined.
        """

    def arguments(self, section: Section, home: str, ros: RosArguments) -> RosArguments:  # noqa: ARG002 - ROS 1 has some
        """With what the graph itself says of the agent (parameters that roslaunch has set)."""
        return ros

    def extras(self, section: Section) -> list[str]:  # noqa: ARG002 - what most need is always there
        """Extras of this distribution that it needs, for the doctor."""
        return []

    # The gate's part.

    @abstractmethod
    def open_sensors(self, way: Way, topics: Topics, trouble: Callable[[str, str], object]) -> Sensors:
        """Where the gate's readings and stops come from.

        Args:
            way: Of the section ``safety``.
            topics: Which.
            trouble: Told a kind and a sentence about each message that is not used.
        """

    @abstractmethod
    def open_wheels(self, way: Way, role: Role, timing: WheelsTiming, enable_topic: str, place: Place | None) -> Wheels:
        """Where velocities go.

        Args:
            way: Of the section ``safety``.
            role: Who writes: the guard's writer, or the gate when that is gone.
            timing: Until when a velocity or a level may be sent.
            enable_topic: Of the enable signal; empty: there is none.
            place: Where whoever sends a velocity on says that it is about to; None: there is nobody who would look.
        """

    @abstractmethod
    def open_display(self, way: Way, topic: str) -> Display:
        """Where what the gate knows is published for people."""

    @abstractmethod
    def wheels_at(self, way: Way) -> str:
        """Where the wheels are, in words that tell one robot's from another's."""

    def prepared(self, way: Way, folder: Path) -> Way:  # noqa: ARG002 - one that has paths makes them absolute
        """The section as the gate's processes take it, which know no folder of robot.yaml.

        Raises:
            ConfigError: Something that it needs is not installed.
        """
        return way

    # What is never the cloud's.

    def wheels(self, names: Names, namespace: str, cmd_vel: str) -> str:
        """Absolute name of what the wheels listen to where there is no gate."""
        return names.own(cmd_vel) if self.remaps_wheels else resolve(cmd_vel, namespace)

    def prefix(self, section: Section) -> str:  # noqa: ARG002 - a bridge to another graph has one
        """What stands before every name of the agent's graph where others see it."""
        return "/"

    def spellings(self, names: Mapping[str, str], way: Way, prefix: str) -> dict[str, str]:  # noqa: ARG002 - as `prefix`
        """How the agent's graph spells the gate's names otherwise: why they are protected, by name.

        Args:
            names: The gate's.
            way: Of the section ``safety``.
            prefix: Of the agent's section.
        """
        return {}
