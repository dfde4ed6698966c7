"""A service that is a ROS 1 graph of its own, with unchanged nodes: ``python -m skytether.service.ros1``.

The manifest says ``graph: ros1`` and names a launch file. Here a roscore is started on a free port; when the robot has
connected and handed over its parameters, roslaunch starts the nodes. The rest is `skytether.service.ros_graph`.
"""

from __future__ import annotations

import logging
import queue
import socket
import sys
import time
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

from skytether.api.grant import Grant
from skytether.ros import notes
from skytether.ros.names import namespace_of
from skytether.ros.notes import Notes
from skytether.ros.ros1.master import MasterError
from skytether.ros.ros1.node import Node
from skytether.ros.ros1.port import CLOCK, Ros1Port
from skytether.wire.topic import Role

from .errors import ConfigError, ServiceError
from .ros_graph import (
    POLL_S,
    GraphType,
    Setting,
    argument,
    guarding,
    receive_from,
    ros_environment,
    run,
    spaces_of,
    with_setup,
)
from .ros_guard import CORE, RosGuard

_log = logging.getLogger("skytether.service.ros1")

_PASSED_ON = ("ROS_PACKAGE_PATH",)
_CORE_S = 30.0
"""For roscore to answer."""


class _Graph:
    """Implements `skytether.service.ros_graph.RosGraph`."""

    program = "roslaunch"

    def __init__(self, setting: Setting, node: Node, guard: RosGuard, arguments: Sequence[str]) -> None:
        self._node = node
        self._notes: queue.SimpleQueue[Notes] = queue.SimpleQueue()
        self.guard = guard
        self.port = Ros1Port(node, Role.SERVICE, setting.names, setting.table, on_notes=self._notes.put)
        self.command = ("roslaunch", *arguments)

    def receive_notes(self, timeout: float) -> bool:
        return receive_from(self._notes, timeout, lambda told: _set_params(self._node, told.params))


@contextmanager
def _join(setting: Setting) -> Iterator[_Graph]:
    grant = setting.grant
    arguments = launch_arguments(setting.launch, grant)
    port = _free_port()
    own = {"ROS_MASTER_URI": f"http://127.0.0.1:{port}", "ROS_IP": "127.0.0.1"}
    environment = ros_environment(setting.environ, setting.folder, own, _PASSED_ON)
    with (
        guarding(setting.folder, with_setup(setting.environ, environment)) as guard,
        Node("skytether", own["ROS_MASTER_URI"], host="127.0.0.1") as node,
    ):
        guard.run(CORE, "roscore", "-p", str(port))
        _wait_for_core(node, guard)
        _set_params(node, {namespace_of(grant.service) + "/" + name: value for name, value in grant.params.items()})
        graph = _Graph(setting, node, guard, arguments)
        try:
            yield graph
        finally:
            graph.port.close()


def _set_params(node: Node, params: Mapping[str, object]) -> None:
    for name, value in params.items():
        try:
            node.master.set_param(name, value)
        except MasterError as error:
            _log.error("parameter %s was not set: %s", name, error)


def _wait_for_core(node: Node, guard: RosGuard) -> None:
    deadline = time.monotonic() + _CORE_S
    while not node.master_present:
        ended = guard.ended()
        if ended:
            raise ServiceError(f"{ended}: is ROS 1 installed here? The image skytether/ros1-base has it")
        if time.monotonic() > deadline:
            raise ServiceError(f"roscore did not answer within {_CORE_S:.0f} s")
        time.sleep(POLL_S)


def launch_arguments(launch: str, grant: Grant) -> list[str]:
    """What roslaunch is called with: the file, and those of the parameters that it has an ``arg`` for.

    ``robot`` and ``service`` are the namespaces of their topics, without the slash.

    Raises:
        ConfigError: There is no such file, or it is no XML.
    """
    known = {**grant.params, **spaces_of(grant)}
    if not launch.startswith("/"):
        package, _, file = launch.partition("/")
        if not file:
            raise ConfigError(f"launch must be an absolute path or package/file.launch, not '{launch}'")
        return [package, file]
    try:
        root = ET.parse(launch).getroot()  # noqa: S314 (the operator's own file; roslaunch reads it the same way)
    except OSError as error:
        raise ConfigError(f"cannot read the launch file {launch}: {error.strerror}") from None
    except ET.ParseError as error:
        raise ConfigError(f"the launch file {launch} is no XML: {error}") from None
    taken = [arg.get("name", "") for arg in root.findall("arg") if arg.get("value") is None]
    return [launch, *(argument(name, known[name]) for name in taken if name in known)]


def _free_port() -> int:
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])


GRAPH = GraphType("ros1", 1, "ros1", (CLOCK, *notes.topics()), told=True, join=_join)

if __name__ == "__main__":
    sys.exit(run(GRAPH))
