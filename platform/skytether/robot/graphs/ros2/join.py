"""How the agent joins a robot's ROS 2 graph."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from skytether.ros.names import resolve
from skytether.ros.ros1.arguments import PRIVATE, RosArguments
from skytether.ros.ros2.config import join_graph
from skytether.ros.ros2.console import Console

from ..graph_config import RobotGraphConfig
from .robot import Ros2Robot, Ros2RobotConfig
from .sections import Ros2Config

_log = logging.getLogger(__name__)


def robot_config(section: Ros2Config, shared: RobotGraphConfig) -> Ros2RobotConfig:
    """What the graph needs of the configuration."""
    return Ros2RobotConfig.extended(shared, node=section.node, cmd_vel_type=section.cmd_vel_type, frame=section.frame)


@contextmanager
def join(section: Ros2Config, shared: RobotGraphConfig, folder: Path, ros: RosArguments) -> Iterator[Ros2Robot]:
    """The robot as a graph, for as long as the context lasts.

    Raises:
        ConfigError: ROS 2 or the extra is missing, or Zenoh does not take a setting.
    """
    config = robot_config(section, shared)
    with join_graph(section, folder, config.home) as node, Console(node, resolve(section.node, config.home)):
        for name in ros.unused:
            _log.warning("the parameter %s is none of %s", name, ", ".join(PRIVATE))
        robot = Ros2Robot(config, node)
        try:
            yield robot
        finally:
            robot.close()
