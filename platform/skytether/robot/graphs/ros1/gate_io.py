"""The gate's way to the hardware of a robot that is a ROS 1 graph: nodes of its own, beside the agent's.

The guard's node publishes the wheels' topic. The gate has one that takes the sensors, and one that publishes the
wheels' topic when the guard is gone. Who is connected stays so when the master dies.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from math import inf

from skytether.control.admittance import Velocity
from skytether.guard.board import Place
from skytether.guard.clock import now as boottime
from skytether.guard.teller import Sent
from skytether.messages import Bool, MarkerArray, Message, Twist, encode, hash_of
from skytether.robot.graphs.wheels_watch import WheelsWatch
from skytether.ros.names import resolve
from skytether.ros.ros1.node import Node, NodeError
from skytether.ros.ros1.publication import Heard
from skytether.ros.ros1.subscription import Listener
from skytether.ros.ros2.native.side.speaking import Speaking

from ..gate_io import WheelsTiming
from ..inbox import Inbox, Topics
from ..ros.gate_io import RosGateNode, RosSensors, RosWheels, not_acknowledged, twist_of
from .sections import Ros1Way

_CONNECTIONS = 128
"""Of one node, twice (`Node`), and 100 more are taken before they are counted: a process of the gate has two nodes, and
1,024 file descriptors."""
_MOST_TWINS = 256
"""Names that are remembered: somebody may make them up."""


class Ros1Wheels(RosWheels[Node]):
    """The wheels' topic, geometry_msgs/Twist.

    Args:
        way: Where it is.
        role: Ends the node's name: ``guard`` for the writer, or ``gate``.
        timing: Nobody gets a velocity or a level that is older than `WheelsTiming.fresh_s`: it is the node's own thread
            that sends them, and this process may stand still meanwhile.
        enable_topic: Of the enable signal, std_msgs/Bool; empty: there is none.
        place: Where that thread says that it is about to send one, and this process that its kernel keeps some.

    Raises:
        OSError: The node cannot be.
    """

    def __init__(
        self, way: Ros1Way, role: str, timing: WheelsTiming, enable_topic: str = "", place: Place | None = None
    ) -> None:
        self._fresh_s = timing.fresh_s
        self._patience_s = timing.guard_s if way.need_acknowledgements else inf
        self._heard: Heard | None = None
        self._names: list[str] = []
        """Of the connections at the last look."""
        self._twins: set[str] = set()
        """Names that two of these had at a time."""
        super().__init__(_start(way, role))
        if place:
            place.keep()
        topic = resolve(way.cmd_vel, way.namespace)
        speaking = Speaking(*place) if place else nullcontext
        self._nodes = [resolve(name, way.namespace) for name in way.wheels_nodes]
        self._renewed: int | None = None
        """How many had come at the last look."""
        self._publication = self._node.advertise(
            topic, Twist.TYPE, hash_of(Twist.TYPE, "ros1"), queue=1, speaking=speaking, awaited=self._nodes
        )
        if role == "gate":
            own = [resolve(f"{way.node}_{each}", way.namespace) for each in ("guard", "gate")]
            self._watch = WheelsWatch(topic, own, partial(self._node.master.publishers, topic))
        self._enable = None
        if enable_topic:
            name = resolve(enable_topic, way.namespace)
            self._enable = self._node.advertise(name, Bool.TYPE, hash_of(Bool.TYPE, "ros1"), queue=1)

    def write(self, velocity: Velocity, until: float = inf) -> None:
        """Wheels: publish it."""
        until = min(until, boottime() + self._fresh_s)
        self._publication.publish(encode(twist_of(velocity), "ros1"), until, self._renewed)

    def enable(self, level: bool) -> None:
        """Wheels: publish it."""
        if self._enable is not None:
            self._enable.publish(encode(Bool(data=level), "ros1"), boottime() + self._fresh_s)

    def sent(self) -> Sent | None:
        """Wheels: what those who listen have, as far as their computers acknowledge it: a program of them may hang."""
        if self._patience_s == inf:
            return None
        self._heard = self._publication.heard(self._patience_s)
        return Sent(self._heard.at, self._heard.at) if self._heard else None

    def unread(self) -> str:
        """Wheels: whose computers do not acknowledge."""
        if self._heard is None or not self._heard.unread:
            return ""
        return not_acknowledged(self._publication.topic, self._heard.unread)

    def listeners(self) -> frozenset[str]:
        """Wheels: the nodes that listen, of those that turn the wheels."""
        # Beside a recorder, say, the wheels' node may have been started again.
        self._renewed = self._publication.renewed  # before them: who comes meanwhile counts as new
        names = self._publication.subscribers
        self._look_for(self._nodes, names, self._publication.topic)
        self._names = [name for name in names if not self._nodes or name in self._nodes]
        return frozenset(f"{name} {self._renewed}" for name in self._names)

    def hearers(self) -> frozenset[str]:
        """Wheels: these nodes; of a name that was ever there twice, nobody knows whether the other one has the same."""
        if len(self._twins) < _MOST_TWINS:
            self._twins |= {name for name, count in Counter(self._names).items() if count > 1}
        return frozenset(f"{name} {os.getpid()}" if name in self._twins else name for name in self._names)


class Ros1Sensors(RosSensors[Node]):
    """Topics of the robot's own sensors.

    Args:
        way: Where they are.
        topics: As configured: absolute, or in the namespace.
        trouble: Told a kind and a sentence about each message that is not used.

    Raises:
        OSError: The node cannot be.
    """

    def __init__(self, way: Ros1Way, topics: Topics, trouble: Callable[[str, str], object]) -> None:
        super().__init__(_start(way, "sensors"), Inbox(topics, "ros1", trouble))
        for name, kind in topics.kinds.items():
            topic = resolve(name, way.namespace)
            self._node.subscribe(topic, kind.TYPE, hash_of(kind.TYPE, "ros1"), self._listener(name))

    def _listener(self, name: str) -> Listener:
        return Listener(lambda data, _: self._inbox.put(name, data))


class Ros1Display(RosGateNode[Node]):
    """A topic for people, visualization_msgs/MarkerArray.

    Args:
        way: Where it is.
        topic: As configured: absolute, or in the namespace.

    Raises:
        OSError: The node cannot be.
    """

    def __init__(self, way: Ros1Way, topic: str) -> None:
        super().__init__(_start(way, "display"))
        kind = MarkerArray.TYPE
        self._publication = self._node.advertise(resolve(topic, way.namespace), kind, hash_of(kind, "ros1"), queue=1)

    def publish(self, message: Message) -> None:
        """Display: publish it."""
        self._publication.publish(encode(message, "ros1"))


def _start(way: Ros1Way, role: str) -> Node:
    node = Node(resolve(f"{way.node}_{role}", way.namespace), way.master, host=way.host, connections=_CONNECTIONS)
    try:
        node.start()
    except NodeError as error:
        raise OSError(str(error)) from error
    return node
