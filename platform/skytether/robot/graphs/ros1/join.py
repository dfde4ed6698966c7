"""How the agent joins a robot's ROS 1 graph, and what that says of the agent."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from skytether.api.config_file import ConfigError
from skytether.ros.names import resolve
from skytether.ros.ros1.arguments import PRIVATE, RosArguments
from skytether.ros.ros1.console import Console
from skytether.ros.ros1.master import Master, MasterError
from skytether.ros.ros1.node import Node, NodeError

from ..graph_config import RobotGraphConfig
from .robot import Ros1Robot, Ros1RobotConfig
from .sections import Ros1Config

_log = logging.getLogger(__name__)


def robot_config(section: Ros1Config, shared: RobotGraphConfig) -> Ros1RobotConfig:
    """What the graph needs of the configuration."""
    return Ros1RobotConfig.extended(shared, params=section.params, use_sim_time=section.use_sim_time)


def node_name(section: Ros1Config, home: str, what: str = "") -> str:
    """Absolute name of the agent's node, or of one that looks for it: the master ends an older one of the name."""
    return resolve(f"{section.node}_{what}" if what else section.node, home)


@contextmanager
def joined_node(section: Ros1Config, name: str, on_end: Callable[[str], None]) -> Iterator[Node]:
    """A node, for as long as the context lasts.

    Raises:
        ConfigError: It cannot be.
    """
    node = Node(name, section.master, host=section.host, on_end=on_end)
    try:
        node.start()
    except NodeError as error:
        raise ConfigError(str(error)) from error
    try:
        yield node
    finally:
        node.close()


@contextmanager
def join(
    section: Ros1Config, shared: RobotGraphConfig, ros: RosArguments, on_end: Callable[[str], None]
) -> Iterator[Ros1Robot]:
    """The robot as a graph, for as long as the context lasts.

    Raises:
        ConfigError: The node cannot be.
    """
    with joined_node(section, node_name(section, shared.home), on_end) as node, Console(node):
        for name in ros.unused:
            _log.warning("the private parameter %s/%s is none of %s", node.name, name, ", ".join(PRIVATE))
        robot = Ros1Robot(robot_config(section, shared), node)
        try:
            yield robot
        finally:
            robot.close()


def private_parameters(section: Ros1Config, home: str, ros: RosArguments) -> RosArguments:
    """With those that roslaunch has set: below the node's name, or below the one that roslaunch takes for it."""
    found: dict[str, Any] = {}
    node = node_name(section, home)
    for name in (f"/{ros.name.lstrip('/')}", node):
        try:
            params = Master(section.master, node).get_param(name)
        except MasterError:  # it has none, or does not answer: the node says so
            continue
        found.update(params if isinstance(params, dict) else {})
    return ros.private(found)
