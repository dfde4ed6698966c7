"""A service that is a ROS 2 graph of its own, with unchanged nodes: ``python -m skytether.service.ros2``.

The manifest says ``graph: ros2`` and names a launch file or a program. Here the graph gets a domain that nobody else
has, discovery that does not leave the machine, and our node; when the robot has connected, the nodes are started. The
rest is `skytether.service.ros_graph`.
"""

from __future__ import annotations

import json
import logging
import os
import shutil
import socket
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from skytether.api.grant import Grant
from skytether.ros import notes
from skytether.ros.ros2.dialect import NodeName
from skytether.ros.ros2.native.interpreter import NAMED
from skytether.ros.ros2.native.node import RclpyNode
from skytether.ros.ros2.parameters import set_request
from skytether.ros.ros2.port import Ros2Port
from skytether.ros.ros2.seam import Ros2Error
from skytether.wire.topic import Role

from .errors import ConfigError, ServiceError
from .ros_graph import (
    SETUP_VARIABLE,
    GraphType,
    Setting,
    argument,
    guarding,
    ros_environment,
    run,
    spaces_of,
    with_setup,
)
from .ros_guard import RosGuard

_log = logging.getLogger("skytether.service.ros2")

LAUNCH_FILES = (".launch", ".launch.py", "_launch.py", ".xml", ".yaml", ".yml")
"""Ends of the names of launch files; anything else is a program."""
DOMAINS = range(101, 0, -1)
"""Whose ports are below those that Linux gives out by itself; the last first, for people take the first."""
_PASSED_ON = (
    "AMENT_PREFIX_PATH",
    "ROS_DISTRO",
    "RMW_IMPLEMENTATION",
    "CYCLONEDDS_URI",
    "FASTDDS_DEFAULT_PROFILES_FILE",
    "FASTRTPS_DEFAULT_PROFILES_FILE",
    "FASTDDS_BUILTIN_TRANSPORTS",
)
_JOIN_S = 30.0
"""For our node to be in the graph."""
_PORT_BASE, _PORTS_OF_DOMAIN, _UNICAST = 7400, 250, 10
"""Of RTPS: where the ports of domain 0 begin, how many a domain has, and where those of participants begin."""

_LAUNCHER = '''\
"""Includes the service's launch file, with its arguments, and gives its nodes the service's parameters."""

from launch import LaunchDescription
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import AnyLaunchDescriptionSource
from launch_ros.actions import SetParametersFromFile
from ros2launch.api import get_share_file_path_from_package

PACKAGE, FILE = {package!r}, {file!r}
ARGUMENTS = {arguments!r}
PARAMETERS = {parameters!r}


def generate_launch_description():
    path = get_share_file_path_from_package(package_name=PACKAGE, file_name=FILE) if PACKAGE else FILE
    include = IncludeLaunchDescription(AnyLaunchDescriptionSource(path), launch_arguments=ARGUMENTS)
    return LaunchDescription([*(SetParametersFromFile(PARAMETERS) for _ in range(bool(PARAMETERS))), include])
'''


class _Graph:
    """Implements `skytether.service.ros_graph.RosGraph`."""

    def __init__(self, setting: Setting, node: RclpyNode, guard: RosGuard, command: list[str]) -> None:
        self.guard = guard
        self.program = Path(setting.launch).name
        self.command = command
        try:
            self.port = Ros2Port(node, setting.table, Role.SERVICE, name_of=setting.names.of)
        except ValueError as error:
            raise ConfigError(f"the manifest of {setting.grant.service} does not fit ROS 2: {error}") from None

    def receive_notes(self, timeout: float) -> bool:
        """ROS 2 keeps no parameters beside its nodes, so a robot of it hands none over."""
        time.sleep(timeout)
        return False


@contextmanager
def _join(setting: Setting) -> Iterator[_Graph]:
    with ExitStack() as stack:
        environment = ros_environment(setting.environ, setting.folder, stack.enter_context(own_domain()), _PASSED_ON)
        environment = with_setup(setting.environ, environment)
        if environment.get("ROS_DISTRO") == "humble":  # does not know of ranges yet
            environment["ROS_LOCALHOST_ONLY"] = "1"
        try:
            node = RclpyNode(NodeName(), python=setting.environ.get(NAMED), environment=environment)
        except Ros2Error as error:
            _log.info("%s", error)
            raise ServiceError(
                "graph: ros2 needs ROS 2 where the service runs, and no Python there has its rclpy: build its image on "
                f"skytether/ros2-base, or name ROS 2's Python ({NAMED}) or setup.bash ({SETUP_VARIABLE})"
            ) from None
        command = nodes_command(setting.launch, setting.grant, environment, node.python, setting.folder)
        guard = stack.enter_context(guarding(setting.folder, environment))
        stack.enter_context(node)
        if not node.wait_until_joined(_JOIN_S):
            raise ServiceError("; ".join(node.troubles) or f"ROS 2 did not let us join within {_JOIN_S:.0f} s")
        graph = _Graph(setting, node, guard, command)
        stack.callback(graph.port.close)
        yield graph


@contextmanager
def own_domain() -> Iterator[dict[str, str]]:
    """What nodes must have in their environment to be in a domain that nobody else has, as long as the context lasts.

    Who else of us has one is known by a socket of a name, which only processes of the same network see: just those
    that ROS 2 could meet. A domain of others is known by its first node's port.

    Raises:
        ServiceError: None is free.
    """
    for domain in DOMAINS:
        with socket.socket(socket.AF_UNIX) as mark, socket.socket(type=socket.SOCK_DGRAM) as first:
            try:
                mark.bind(f"\0skytether-ros2-domain-{domain}")
                first.bind(("", _PORT_BASE + _PORTS_OF_DOMAIN * domain + _UNICAST))
            except OSError:
                continue
            first.close()
            yield {"ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
            return
    raise ServiceError(f"all {len(DOMAINS)} domains of ROS 2 are in use in this network")


def nodes_command(launch: str, grant: Grant, environment: Mapping[str, str], python: str, folder: Path) -> list[str]:
    """What starts the nodes: ``ros2 launch``, ``ros2 run``, or the program itself.

    Args:
        launch: What the manifest says.
        grant: Whose parameters all the nodes get.
        environment: Of the nodes.
        python: That has ROS 2, for programs in Python.
        folder: Of the graph, for files.

    Raises:
        ConfigError: It is not there, or a parameter can be none of ROS 2.
    """
    parameters = _parameters_file(grant, folder)
    is_file = launch.startswith("/")
    package, _, name = ("", "", launch) if is_file else launch.partition("/")
    if is_file and not Path(launch).is_file():
        raise ConfigError(f"cannot read {launch}, which launch names: there is no such file where the service runs")
    if not is_file and not name:
        raise ConfigError(f"launch must be an absolute path, package/file.launch.py or package/program, not '{launch}'")
    is_launch_file = launch.endswith(LAUNCH_FILES)
    if (is_launch_file or not is_file) and shutil.which("ros2", path=environment.get("PATH")) is None:
        raise ConfigError(
            f"launch: {launch} needs the program 'ros2', which is not in this image: build it on "
            "skytether/ros2-base made from ros:jazzy, or name a program by its absolute path"
        )
    if is_launch_file:
        launcher = folder / "nodes.launch.py"
        known = {**grant.params, **spaces_of(grant)}
        arguments = [tuple(argument(key, value).split(":=", 1)) for key, value in known.items()]
        text = _LAUNCHER.format(package=package, file=name, arguments=arguments, parameters=str(parameters or ""))
        launcher.write_text(text)
        return ["ros2", "launch", str(launcher)]
    more = ["--ros-args", "--params-file", str(parameters)] if parameters else []
    if not is_file:
        return ["ros2", "run", package, name, *more]
    if launch.endswith(".py"):
        return [python, launch, *more]
    if not os.access(launch, os.X_OK):
        raise ConfigError(f"launch: {launch} may not be run: chmod +x, or end its name in .py")
    return [launch, *more]


def _parameters_file(grant: Grant, folder: Path) -> Path | None:
    """The service's parameters, as a file that any node takes; None: there are none.

    Raises:
        ConfigError: One can be none of ROS 2.
    """
    if not grant.params:
        return None
    try:
        set_request(_flat(grant.params))
    except (ValueError, OverflowError) as error:
        raise ConfigError(f"ROS 2 takes no such value: {error}") from None
    path = folder / "parameters.yaml"
    # JSON is YAML, and all its texts are in quotes, so that none is taken for a number.
    path.write_text(json.dumps({"/**": {"ros__parameters": grant.params}}, ensure_ascii=False))
    return path


def _flat(params: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Groups as ROS 2 has them: ``planner.speed``."""
    found: dict[str, Any] = {}
    for name, value in params.items():
        found |= _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value}
    return found


GRAPH = GraphType("ros2", 2, "cdr", (notes.row(Role.ROBOT),), told=False, join=_join)

if __name__ == "__main__":
    sys.exit(run(GRAPH))
