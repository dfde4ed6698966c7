"""A robot that is a ROS 1 graph, as a kind of graph.

What speaks to the graph is loaded when it is opened: a gate needs nothing of what an agent needs.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from skytether.api.manifest import Manifest
from skytether.guard.board import Place
from skytether.messages import Encoding
from skytether.ros.names import Generation, resolve

from ..kind import GraphKind, Role
from .sections import Ros1Config, Ros1Way

if TYPE_CHECKING:
    from skytether.ros.ros1.arguments import RosArguments

    from ..finding import Finding
    from ..gate_io import Display, Sensors, Wheels, WheelsTiming
    from ..graph_config import RobotGraphConfig
    from ..inbox import Topics
    from .robot import Ros1Robot


class Ros1(GraphKind[Ros1Config, Ros1Way]):
    """Nodes of our own, at the robot's master."""

    key: ClassVar[str] = "ros1"
    generation: ClassVar[Generation] = 1
    encoding: ClassVar[Encoding] = "ros1"
    remaps_wheels: ClassVar[bool] = False
    todo: ClassVar[str] = "correct ros1.host or ros1.node in robot.yaml"
    section = Ros1Config
    gate_section = Ros1Way

    @contextmanager
    def join(
        self,
        section: Ros1Config,
        config: RobotGraphConfig,
        folder: Path,  # noqa: ARG002 - it has no paths
        ros: RosArguments,
        on_end: Callable[[str], None],
    ) -> Iterator[Ros1Robot]:
        from .join import join

        with join(section, config, ros, on_end) as robot:
            yield robot

    def check(
        self,
        section: Ros1Config,
        config: RobotGraphConfig,
        folder: Path,  # noqa: ARG002 - it has no paths
        *,
        manifest: Manifest | None,
        command_topic: str,
        role: str,
    ) -> list[Finding]:
        from .check import check_graph

        return check_graph(section, config, manifest, command_topic, role)

    def arguments(self, section: Ros1Config, home: str, ros: RosArguments) -> RosArguments:
        from .join import private_parameters

        return private_parameters(section, home, ros) if ros.name else ros

    def open_sensors(self, way: Ros1Way, topics: Topics, trouble: Callable[[str, str], object]) -> Sensors:
        from .gate_io import Ros1Sensors

        return Ros1Sensors(way, topics, trouble)

    def open_wheels(
        self, way: Ros1Way, role: Role, timing: WheelsTiming, enable_topic: str, place: Place | None
    ) -> Wheels:
        from .gate_io import Ros1Wheels

        return Ros1Wheels(way, role, timing, enable_topic, place)

    def open_display(self, way: Ros1Way, topic: str) -> Display:
        from .gate_io import Ros1Display

        return Ros1Display(way, topic)

    def wheels_at(self, way: Ros1Way) -> str:
        master = re.sub(r"//(127\.0\.0\.1|\[::1\])", "//localhost", way.master).rstrip("/")
        return f"{resolve(way.cmd_vel, way.namespace)} at the ROS master {master}"
