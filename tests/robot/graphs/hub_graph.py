"""A made-up kind of robot graph, as somebody else would add one: this file, and its registration as an entry point.

Its nodes are sockets of datagrams, ``TOPIC NUL MESSAGE`` as CDR. A hub takes all of them and hands each on to those
that asked for its topic with ``+TOPIC``.
"""

import socket
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from typing import ClassVar

from pydantic import Field

from skytether.api.manifest import TopicSpec
from skytether.messages import Bool, Encoding, Message, Twist, Vector3, encode, type_of
from skytether.robot.graphs.finding import Finding
from skytether.robot.graphs.graph_base import GraphBase, nowhere
from skytether.robot.graphs.graph_config import RobotGraphConfig
from skytether.robot.graphs.inbox import Inbox
from skytether.robot.graphs.kind import GateSection, GraphKind, RobotSection
from skytether.robot.session.topic_table import Offer, robot_table, spoken
from skytether.ros.names import resolve
from skytether.wire.topic import Topic


class HubSection(RobotSection):
    """Of robot.yaml."""

    port: int = Field(ge=1, le=65_535)


class HubWay(GateSection):
    """Below ``safety``; taken from the robot's own unless it is written."""

    port: int = Field(ge=1, le=65_535)


class Node:
    """One socket at the hub, and a thread that listens."""

    def __init__(self, port: int) -> None:
        self._listeners: dict[str, Callable[[bytes], object]] = {}
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect(("127.0.0.1", port))
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    def subscribe(self, topic: str, listener: Callable[[bytes], object]) -> None:
        self._listeners[topic] = listener
        self._socket.send(b"+" + topic.encode())

    def publish(self, topic: str, payload: bytes | memoryview) -> None:
        self._socket.send(topic.encode() + b"\0" + payload)

    def close(self) -> None:
        with suppress(OSError):  # the hub is gone
            self._socket.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        self._socket.close()

    def _listen(self) -> None:
        while True:
            try:
                data = self._socket.recv(65_536)
            except ConnectionRefusedError:
                continue
            if not data:
                return
            topic, _, payload = data.partition(b"\0")
            listener = self._listeners.get(topic.decode())
            if listener is not None:
                listener(payload)


class HubPort:
    """The service's topics in the graph, for one session."""

    def __init__(self, node: Node, table: Iterable, skip: str, names: Mapping[str, str]) -> None:
        self._node, self._skip, self._names = node, skip, names
        self._topics = [topic.name for topic in table]
        self._publisher = None

    def attach(self, publisher) -> None:
        self._publisher = publisher
        for name in self._topics:
            if name in self._names:
                self._node.subscribe(self._names[name], partial(self._send, name))

    def _send(self, name: str, payload: bytes) -> None:
        self._publisher.publish(name, payload)

    def deliver(self, message) -> None:
        self._node.publish(message.topic, message.payload)

    def notify(self, event) -> None:
        """Nobody asks."""


class HubRobot:
    """The robot, for its agent."""

    encoding: Encoding = "cdr"

    def __init__(self, config: RobotGraphConfig, node: Node) -> None:
        self._config, self._node = config, node
        readings = {name: type_of(kind) for name, kind in config.readings.items()}
        send = nowhere
        if config.cmd_vel is not None:
            send = partial(node.publish, resolve(config.cmd_vel, config.home))
        self.base = GraphBase(readings, "cdr", send, idle_s=config.idle_s)
        for name in readings:
            node.subscribe(config.names(()).own(name), partial(self.base.put, name))

    def open(self, specs: Sequence[TopicSpec], command_topic: str) -> tuple[tuple[Topic, ...], HubPort]:
        specs = spoken(specs, None)
        taken = {spec.name: spec.type for spec in specs if spec.direction == "in"}
        table = robot_table(specs, {name: Offer(kind) for name, kind in taken.items()})
        names = self._config.names(specs)
        return table, HubPort(self._node, table, command_topic, {name: names.of(name) for name in taken})


class HubSensors:
    def __init__(self, way: HubWay, topics, trouble) -> None:
        self._inbox = Inbox(topics, "cdr", trouble)
        self._node = Node(way.port)
        for name in topics.kinds:
            self._node.subscribe(resolve(name, way.namespace), partial(self._inbox.put, name))
        self.stops, self.read, self.close = self._inbox.drain_stops, self._inbox.drain, self._node.close


class HubWheels:
    def __init__(self, way: HubWay, enable_topic: str) -> None:
        self._topic, self._enable = resolve(way.cmd_vel, way.namespace), resolve(enable_topic or "e", way.namespace)
        self._node = Node(way.port)
        self.close = self._node.close

    def write(self, velocity, until=0.0) -> None:
        twist = Twist(linear=Vector3(x=velocity.linear), angular=Vector3(z=velocity.angular))
        self._node.publish(self._topic, encode(twist))

    def enable(self, level: bool) -> None:
        self._node.publish(self._enable, encode(Bool(data=level)))

    def full(self) -> bool:
        return False

    def sent(self) -> None:
        return None

    def unread(self) -> str:
        return ""

    def listeners(self) -> None:
        return None

    def hearers(self) -> frozenset[str]:
        return frozenset()


class HubDisplay:
    def __init__(self, way: HubWay, topic: str) -> None:
        self._topic, self._node = resolve(topic, way.namespace), Node(way.port)
        self.close = self._node.close

    def publish(self, message: Message) -> None:
        self._node.publish(self._topic, encode(message))


class Hub(GraphKind[HubSection, HubWay]):
    """The kind."""

    key: ClassVar[str] = "hub"
    section = HubSection
    gate_section = HubWay

    @contextmanager
    def join(self, section, config, folder, ros, on_end) -> Iterator[HubRobot]:
        node = Node(section.port)
        try:
            yield HubRobot(config, node)
        finally:
            node.close()

    def check(self, section, config, folder, *, manifest, command_topic, role) -> list[Finding]:
        return [Finding("hub", f"127.0.0.1:{section.port}", "", f"is looked at by the {role}")]

    def open_sensors(self, way, topics, trouble) -> HubSensors:
        return HubSensors(way, topics, trouble)

    def open_wheels(self, way, role, timing, enable_topic, place) -> HubWheels:
        return HubWheels(way, enable_topic)

    def open_display(self, way, topic) -> HubDisplay:
        return HubDisplay(way, topic)

    def wheels_at(self, way) -> str:
        return f"{resolve(way.cmd_vel, way.namespace)} of the hub at {way.port}"
