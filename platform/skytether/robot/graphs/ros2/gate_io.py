"""The gate's way to the hardware of a robot that is a ROS 2 graph: nodes of its own in it.

A graph that is lost (the program that is our node, or a Zenoh router) takes sensors and wheels away at once: a base
that is told nothing must stop by itself.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from math import inf

from skytether.control.admittance import Velocity
from skytether.guard.board import Place
from skytether.guard.teller import Sent
from skytether.guard.velocity import STANDSTILL
from skytether.messages import Bool, Header, MarkerArray, Message, Time, Twist, TwistStamped, encode, hash_of
from skytether.robot.graphs.wheels_watch import WheelsWatch
from skytether.ros.names import resolve
from skytether.ros.ros2.dialect import Endpoint, Kind, NodeName
from skytether.ros.ros2.join import make_node
from skytether.ros.ros2.qos import Qos
from skytether.ros.ros2.seam import GraphNode, Ros2Error
from skytether.ros.ros2.sim_time import GraphClock

from ..gate_io import WheelsTiming
from ..inbox import Inbox, Topics
from ..ros.gate_io import RosGateNode, RosSensors, RosWheels, not_acknowledged, twist_of
from .sections import Ros2Way

_STOPS = 10_000
"""Words of a button, bumper or cliff sensor that wait while the gate hangs: minutes of them."""


class Ros2Wheels(RosWheels[GraphNode]):
    """The wheels' topic, geometry_msgs/msg/Twist or TwistStamped.

    Args:
        way: Where it is.
        role: Ends the node's name: ``guard`` for the writer, or ``gate``.
        timing: Nobody gets a velocity or a level that is older than `WheelsTiming.fresh_s`: the program that has the
            node sends them, and it, or this process, may stand still meanwhile. While it does, nobody listens.
        enable_topic: Of the enable signal, std_msgs/msg/Bool; empty: there is none.
        place: Where the program says that it is about to send one.

    Raises:
        OSError: The node cannot be.
    """

    def __init__(
        self, way: Ros2Way, role: str, timing: WheelsTiming, enable_topic: str = "", place: Place | None = None
    ) -> None:
        self._way, self._place = way, place
        self._lives = frozenset[str]()
        super().__init__(_start(way, role, place))
        self._clock = GraphClock(self._node)
        self._topic = resolve(way.cmd_vel, way.namespace)
        stand = Twist() if way.cmd_vel_type == Twist.TYPE else TwistStamped()
        farewell = encode(stand) if role == "guard" else b""
        endpoint = _endpoint(Kind.PUBLISHER, self._topic, way.cmd_vel_type)
        self._speaks_s = timing.fresh_s / 4  # of 1.5 periods: who says something for longer stands still
        self._patience_s = timing.guard_s if way.need_acknowledgements else inf
        publish = partial(self._node.publish, fresh_s=timing.fresh_s, stuck_s=timing.stuck_s)
        self._nodes = [resolve(name, way.namespace) for name in way.wheels_nodes]
        self._publication = publish(endpoint, farewell=farewell, farewell_after_s=timing.brakes_s, awaited=self._nodes)
        if role == "gate":
            own = [resolve(f"{way.node}_guard", way.namespace)]  # this node does not see itself
            self._watch = WheelsWatch(self._topic, own, self._publishers)
        self._renewed: int | None = None
        """How many had come at the last look."""
        self._enable = None
        if enable_topic:
            name = resolve(enable_topic, way.namespace)
            self._enable = publish(_endpoint(Kind.PUBLISHER, name, Bool.TYPE))

    def write(self, velocity: Velocity, until: float = inf) -> None:
        """Wheels: publish it."""
        twist, stands = twist_of(velocity), velocity == STANDSTILL
        if self._way.cmd_vel_type == TwistStamped.TYPE:
            header = Header(Time.from_seconds(self._clock()), self._way.frame)
            self._publication.put(encode(TwistStamped(header, twist)), until, self._renewed, first=stands)
        else:
            self._publication.put(encode(twist), until, self._renewed, first=stands)

    def enable(self, level: bool) -> None:
        """Wheels: publish it."""
        if self._enable is not None:
            self._enable.put(encode(Bool(data=level)))

    def unread(self) -> str:
        """Wheels: who listens, if not all of them acknowledge; the middleware does not tell who it is."""
        if self._publication.unread_s <= self._patience_s:
            return ""
        there = self._node.endpoints(self._topic, Kind.SUBSCRIPTION)
        return not_acknowledged(self._topic, (endpoint.node for endpoint in there))

    def listeners(self) -> frozenset[str]:
        """Wheels: the nodes that listen, of those that turn the wheels; none while they cannot be told anything."""
        if self._publication.refused:
            return frozenset()
        if self._way.cmd_vel_type == TwistStamped.TYPE:
            self._clock()  # or the gate would hear no time before its first velocity
        lives = self._lives = frozenset(self._node.lives(self._topic, Kind.SUBSCRIPTION, self._nodes))
        self._renewed = self._publication.renewed
        if self._nodes:
            there = [endpoint.node for endpoint in self._node.endpoints(self._topic, Kind.SUBSCRIPTION)]
            self._look_for(self._nodes, there, self._topic)
        if self._renewed is None:
            return lives
        # When who comes, or comes in another's place, is to hear a first word, who publishes knows sooner.
        return frozenset({str(self._renewed)} if lives else ())

    def hearers(self) -> frozenset[str]:
        """Wheels: these nodes' endpoints."""
        return self._lives

    def sent(self) -> Sent:
        """Wheels: what the program has published, or cannot."""
        stuck = self._publication.stuck
        if stuck and self._place is not None:  # who would take over may be dead
            self._place.end_speaker(self._speaks_s)
        publication, acknowledged = self._publication, self._way.need_acknowledgements
        heard_at = publication.heard_at if acknowledged else publication.left_at
        lost = stuck or publication.lost
        return Sent(publication.left_at, heard_at, lost, stuck, unheard=acknowledged and not publication.heard)

    @property
    def troubles(self) -> tuple[str, ...]:
        """KnowsTheDeaf: of the node; a subscription that asks for more than we offer is among them."""
        return self._node.troubles

    def _publishers(self) -> list[str]:
        return [endpoint.node for endpoint in self._node.endpoints(self._topic, Kind.PUBLISHER)]


class Ros2Sensors(RosSensors[GraphNode]):
    """Topics of the robot's own sensors.

    Args:
        way: Where they are.
        topics: As configured: absolute, or in the namespace.
        trouble: Told a kind and a sentence about each message that is not used.

    Raises:
        OSError: The node cannot be.
    """

    def __init__(self, way: Ros2Way, topics: Topics, trouble: Callable[[str, str], object]) -> None:
        super().__init__(_start(way, "sensors"), Inbox(topics, "cdr", trouble))
        for name, kind in topics.kinds.items():
            endpoint = _endpoint(Kind.SUBSCRIPTION, resolve(name, way.namespace), kind.TYPE)
            stops = name in topics.stops
            if stops:  # whatever the gate does meanwhile, none may be pushed out by a release
                endpoint = replace(endpoint, qos=replace(endpoint.qos, depth=_STOPS), priority=1)
            # Of two buttons one may have been pressed before, and keep that for who comes.
            self._node.subscribe(endpoint, partial(self._inbox.put, name), every_kept=stops)


class Ros2Display(RosGateNode[GraphNode]):
    """A topic for people, visualization_msgs/msg/MarkerArray.

    Args:
        way: Where it is.
        topic: As configured: absolute, or in the namespace.

    Raises:
        OSError: The node cannot be.
    """

    def __init__(self, way: Ros2Way, topic: str) -> None:
        super().__init__(_start(way, "display"))
        name = resolve(topic, way.namespace)
        self._publication = self._node.publish(_endpoint(Kind.PUBLISHER, name, MarkerArray.TYPE))

    def publish(self, message: Message) -> None:
        """Display: publish it."""
        self._publication.put(encode(message))


def _start(way: Ros2Way, role: str, place: Place | None = None) -> GraphNode:
    name = NodeName(way.namespace, f"{way.node}_{role}")
    try:
        node = make_node(way, name, way.zenoh_config, place)
    except Ros2Error as error:
        raise OSError(str(error)) from error
    node.start()
    return node


def _endpoint(kind: Kind, name: str, type_name: str) -> Endpoint:
    # Sensors are taken reliable or not; wheels that ask for reliable get that.
    return Endpoint(kind, name, type_name, hash_of(type_name, "cdr"), Qos(reliable=kind is Kind.PUBLISHER, depth=1))
