"""Two ROS 1 graphs joined by a bridge, for tests: nodes, ports and bridges of both ends."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Any

from ros1_graph import Ros1Graph, wait_for

from skytether.api.manifest import TopicSpec
from skytether.bridge import Bridge, SessionSpec
from skytether.bridge.spec import topics_from_api
from skytether.robot.graphs.ros1.robot import Ros1Robot, Ros1RobotConfig
from skytether.ros import notes
from skytether.ros.names import Names, namespace_of
from skytether.ros.ros1.node import Node
from skytether.ros.ros1.port import CLOCK, Ros1Port
from skytether.wire.topic import Role

KEY = bytes(range(32))
ROBOT, SERVICE = "walker", "navigation"


class Pair:
    """A robot's graph and a service's, and what Skytether adds to each.

    Args:
        robot: The robot's graph.
        service: The service's.
        specs: The service's topics.
        config: Of the robot, beside its name.
        remap: In the service's graph.
        address: Where the service's end listens.
        inside: Runs a function where the robot's and the service's end are.
    """

    def __init__(
        self,
        robot: Ros1Graph,
        service: Ros1Graph,
        specs: Sequence[TopicSpec],
        *,
        config: dict[str, Any] | None = None,
        remap: dict[str, str] | None = None,
        address: str = "127.0.0.1",
        inside: tuple[Callable[[Callable[[], Any]], Any], ...] = (lambda f: f(), lambda f: f()),
    ) -> None:
        self.told: list[notes.Notes] = []
        self._stack = ExitStack()
        in_robot, in_service = inside
        self.service_node = in_service(lambda: self._enter(Node("skytether", service.uri, look_s=0.2)))
        table = (*topics_from_api(specs), CLOCK, *notes.topics())
        names = Names(specs, namespace_of(ROBOT), namespace_of(SERVICE), remap)
        self.service_port = Ros1Port(
            self.service_node, Role.SERVICE, names, table, on_notes=self.told.append, survey_s=0.2
        )
        self.service = Bridge(SessionSpec(7, KEY, Role.SERVICE, table), self.service_port, bind=(address, 0))
        in_service(lambda: self._enter(self.service))
        self._stack.callback(self.service_port.close)
        self.robot_node = in_robot(lambda: self._enter(Node("skytether", robot.uri, look_s=0.2)))
        self.robot = Ros1Robot(Ros1RobotConfig(ROBOT, SERVICE, **(config or {})), self.robot_node)
        self._stack.callback(self.robot.close)
        topics, port = in_robot(lambda: self.robot.open(specs, "cmd_vel"))
        bind = ("0.0.0.0" if address != "127.0.0.1" else address, 0)
        self.bridge = Bridge(SessionSpec(7, KEY, Role.ROBOT, topics), port, bind=bind, peer=self.service.address)
        in_robot(lambda: self._enter(self.bridge))
        wait_for(lambda: self.bridge.stats().connected and self.service.stats().connected, "the session")

    def _enter(self, what: Any) -> Any:
        return self._stack.enter_context(what)

    def close(self) -> None:
        self._stack.close()
