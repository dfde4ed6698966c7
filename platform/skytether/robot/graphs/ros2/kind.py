"""A robot that is a ROS 2 graph, as a kind of graph.

What speaks to the graph is loaded when it is opened: a gate needs nothing of what an agent needs.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from skytether.api.manifest import Manifest
from skytether.guard.board import Place
from skytether.ros.names import resolve
from skytether.ros.ros2.config import need_extra

from ..kind import GraphKind, Role
from .sections import Ros2Config, Ros2Way

if TYPE_CHECKING:
    from skytether.ros.ros1.arguments import RosArguments

    from ..finding import Finding
    from ..gate_io import Display, Sensors, Wheels, WheelsTiming
    from ..graph_config import RobotGraphConfig
    from ..inbox import Topics
    from .robot import Ros2Robot


class Ros2(GraphKind[Ros2Config, Ros2Way]):
    """Nodes of our own, under the ROS 2 of this machine or by a Zenoh router."""

    key: ClassVar[str] = "ros2"
    todo: ClassVar[str] = "source ROS 2 and start the robot's nodes, or correct ros2 in robot.yaml"
    section = Ros2Config
    gate_section = Ros2Way

    @contextmanager
    def join(
        self,
        section: Ros2Config,
        config: RobotGraphConfig,
        folder: Path,
        ros: RosArguments,
        on_end: Callable[[str], None],  # noqa: ARG002 - nobody ends a node of ROS 2 from afar
    ) -> Iterator[Ros2Robot]:
        from .join import join

        with join(section, config, folder, ros) as robot:
            yield robot

    def check(
        self,
        section: Ros2Config,
        config: RobotGraphConfig,
        folder: Path,
        *,
        manifest: Manifest | None,
        command_topic: str,
        role: str,  # noqa: ARG002 - two nodes of one name may be there
    ) -> list[Finding]:
        from .check import check_graph

        return check_graph(section, config, folder, manifest, command_topic)

    def extras(self, section: Ros2Config) -> list[str]:
        return ["ros2"] if section.dialect != "rclpy" else []

    def open_sensors(self, way: Ros2Way, topics: Topics, trouble: Callable[[str, str], object]) -> Sensors:
        from .gate_io import Ros2Sensors

        return Ros2Sensors(way, topics, trouble)

    def open_wheels(
        self, way: Ros2Way, role: Role, timing: WheelsTiming, enable_topic: str, place: Place | None
    ) -> Wheels:
        from .gate_io import Ros2Wheels

        return Ros2Wheels(way, role, timing, enable_topic, place)

    def open_display(self, way: Ros2Way, topic: str) -> Display:
        from .gate_io import Ros2Display

        return Ros2Display(way, topic)

    def wheels_at(self, way: Ros2Way) -> str:
        name = resolve(way.cmd_vel, way.namespace)
        domain = way.domain if way.domain is not None else os.environ.get("ROS_DOMAIN_ID") or 0
        if way.dialect == "rclpy":
            return f"{name} of the ROS 2 domain {domain}"
        return f"{name} of the ROS 2 domain {domain} by {way.router or way.zenoh_config or 'the usual router'}"

    def prepared(self, way: Ros2Way, folder: Path) -> Ros2Way:
        if way.dialect != "rclpy":
            need_extra()
        if way.zenoh_config is None:
            return way
        return way.model_copy(update={"zenoh_config": folder.absolute() / way.zenoh_config})

    def prefix(self, section: Ros2Config) -> str:
        """Of a bridge to DDS."""
        return section.bridge_namespace if section.dialect == "ros2dds" else "/"

    def spellings(self, names: Mapping[str, str], way: Ros2Way, prefix: str) -> dict[str, str]:
        """The gate's keys of Zenoh, where the agent's bridge to DDS has another namespace."""
        if "bridge_namespace" not in way.model_fields_set:
            return {}
        theirs, ours = way.bridge_namespace.rstrip("/"), prefix.rstrip("/")
        keys = {f"{theirs}{name}": why for name, why in names.items()}
        return {key.removeprefix(ours): why for key, why in keys.items() if key.startswith(f"{ours}/")}
