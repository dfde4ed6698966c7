"""A robot that is a ROS 2 graph: its topics for the service, its readings, its wheels."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from skytether.api.manifest import ANY_TOPIC, TopicSpec
from skytether.bridge.port import Port
from skytether.messages import (
    Encoding,
    Header,
    Message,
    Time,
    Twist,
    TwistStamped,
    encode,
    encode_plain,
    hash_of,
    type_of,
)
from skytether.ros import notes
from skytether.ros.followed import Followed
from skytether.ros.names import resolve
from skytether.ros.ros2.dialect import Endpoint, Kind
from skytether.ros.ros2.followed import followed
from skytether.ros.ros2.port import Ros2Port
from skytether.ros.ros2.qos import Qos
from skytether.ros.ros2.seam import GraphNode, Handle, Publication
from skytether.ros.ros2.sim_time import GraphClock
from skytether.wire.topic import ANY, Role, Topic

from ...session.topic_table import robot_table, spoken
from ..graph_base import GraphBase, nowhere
from ..graph_config import RobotGraphConfig
from ..ros.robot import RosRobot
from ..wheels_watch import WheelsWatch

WHEELS = (Twist.TYPE, TwistStamped.TYPE)
"""What wheels may take: nav2 and ros2_control have the second from Jazzy on."""


_FRESH_S = 0.1
"""Nobody gets a velocity that waited for longer in the program that has our node [s]."""


@dataclass(frozen=True, slots=True)
class Ros2RobotConfig(RobotGraphConfig):
    """Where in its graph the robot's things are.

    Attributes:
        node: Name of the agent's node, in the robot's namespace.
        cmd_vel_type: One of `WHEELS`.
        frame: Coordinate frame of stamped velocities.
    """

    node: str = "skytether"
    cmd_vel_type: str = Twist.TYPE
    frame: str = "base_link"


class Ros2Robot(RosRobot):
    """Implements `skytether.robot.graphs.graph_base.Graph`.

    Attributes:
        base: For the agent: readings and wheels.

    Args:
        config: What is where.
        node: Started; it stays the caller's.
        clock: Seconds, for stamped velocities; None: the graph's time.
    """

    encoding: Encoding = "cdr"

    def __init__(self, config: Ros2RobotConfig, node: GraphNode, *, clock: Callable[[], float] | None = None) -> None:
        super().__init__(config)
        self._config: Ros2RobotConfig = config
        self._node = node
        self._clock = clock or GraphClock(node)
        self._port: Ros2Port | None = None
        self._diagnostics: Publication | None = None
        self._own: list[tuple[str, Handle]] = []
        """Readings and wheels, by the robot's names."""
        self._told = False
        own = config.names(())
        send: Callable[[bytes], object] = nowhere
        heard: Callable[[], bool] = _always
        if config.cmd_vel is not None:
            stand: Message = Twist() if config.cmd_vel_type == Twist.TYPE else TwistStamped()
            endpoint = self._endpoint(Kind.PUBLISHER, own.own(config.cmd_vel), config.cmd_vel_type)
            wheels = node.publish(endpoint, farewell=encode(stand), fresh_s=_FRESH_S)
            self._ends.append(wheels.close)
            self._own.append((config.cmd_vel, wheels))

            def heard() -> bool:
                return wheels.heard

            def send(velocity: bytes) -> bool:
                taken = wheels.put(velocity)
                if not taken and self._told:  # then the loop goes on from standstill when they can be told again
                    raise ConnectionError(
                        wheels.refused or "the wheels cannot be told: our ROS 2 node is lost, or hangs"
                    )
                self._told |= taken
                return taken

        readings: dict[str, type[Message]] = {name: type_of(kind) for name, kind in config.readings.items()}
        make = self._stamped if config.cmd_vel_type == TwistStamped.TYPE else _as_it_is
        self.base = GraphBase(readings, self.encoding, send, make=make, idle_s=config.idle_s, heard=heard)
        for name, cls in readings.items():
            endpoint = self._endpoint(Kind.SUBSCRIPTION, own.own(name), cls.TYPE)
            reading = node.subscribe(endpoint, partial(self.base.put, name))
            self._ends.append(reading.close)
            self._own.append((name, reading))
        if config.wheels is not None:
            self._watch = WheelsWatch(config.wheels, config.drivers, partial(self._publishers, config.wheels))

    def _publishers(self, topic: str) -> list[str]:
        """Names of the nodes of others that publish a topic; this one's is not among them."""
        return [endpoint.node for endpoint in self._node.endpoints(topic, Kind.PUBLISHER)]

    @property
    def name(self) -> str:
        """PublishesDiagnostics: the node's."""
        return resolve(self._config.node, self._config.home)

    def publish_diagnostics(self, type_name: str, topic: str, values: Mapping[str, Any]) -> None:
        """PublishesDiagnostics: from one thread."""
        if self._diagnostics is None:
            name = self._config.names(()).own(topic)
            qos = Qos(reliable=True, depth=1)
            self._diagnostics = self._node.publish(
                Endpoint(Kind.PUBLISHER, name, type_name, hash_of(type_name, "cdr"), qos)
            )
            self._ends.append(self._diagnostics.close)
        self._diagnostics.put(encode_plain(type_name, values, "cdr"))

    def topics(self) -> list[Followed]:
        """How the service's topics, and the robot's own, stand in the graph now; from any thread."""
        found = [] if self._port is None else self._port.topics()
        known = {(topic.graph, topic.way) for topic in found}
        own = (followed(self._node, name, handle.endpoint, handle) for name, handle in self._own)
        waits = (
            Followed(name, name, "any", "from")
            for name in (resolve(name, self._config.home) for name in self._config.topics)
            if (name, "from") not in known
        )
        return [*found, *(topic for topic in (*own, *waits) if (topic.graph, topic.way) not in known)]

    def open(self, specs: Sequence[TopicSpec], command_topic: str) -> tuple[tuple[Topic, ...], Port]:
        specs = spoken(specs, "ros2_action")
        remapped = (*self._config.readings, self._config.cmd_vel or "", "/diagnostics")
        names, may = self._checked(specs, command_topic, remapped)
        topics = robot_table(specs, self._offers(specs), encoding=self.encoding)
        if any(spec.name == ANY_TOPIC for spec in specs):
            topics = (*topics, notes.row(Role.ROBOT))
        if self._port is not None:
            self._port.close()
        self._port = Ros2Port(self._node, topics, Role.ROBOT, name_of=names.of, skip=(command_topic,), permissions=may)
        return topics, self._port

    def close(self) -> None:
        super().close()
        if isinstance(self._clock, GraphClock):
            self._clock.close()

    def _stamped(self, twist: Twist) -> TwistStamped:
        return TwistStamped(Header(Time.from_seconds(self._clock()), self._config.frame), twist)

    def _types(self, names: Sequence[str]) -> dict[str, str]:
        return {name: next((other.type for other in self._node.endpoints(name, Kind.PUBLISHER)), ANY) for name in names}

    @staticmethod
    def _endpoint(kind: Kind, name: str, type_name: str) -> Endpoint:
        # A reading takes what there is, reliable or not; wheels that ask for reliable get that.
        qos = Qos(reliable=kind is Kind.PUBLISHER, depth=1)
        return Endpoint(kind, name, type_name, hash_of(type_name, "cdr"), qos)


def _as_it_is(twist: Twist) -> Message:
    return twist


def _always() -> bool:
    return True
