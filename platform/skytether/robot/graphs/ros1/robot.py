"""A robot that is a ROS 1 graph: its topics for the service, its readings, its wheels."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

from skytether.api.manifest import TopicSpec
from skytether.bridge.port import Port
from skytether.guard.clock import now as boottime
from skytether.messages import Encoding, Message, Twist, encode_plain, hash_of, type_of
from skytether.ros import notes
from skytether.ros.followed import Followed
from skytether.ros.names import Generation, bridge_type, resolve
from skytether.ros.ros1.followed import taken
from skytether.ros.ros1.master import MasterError, RefusedError
from skytether.ros.ros1.node import Node
from skytether.ros.ros1.port import CLOCK, SIM_TIME, Ros1Port
from skytether.ros.ros1.publication import Publication
from skytether.ros.ros1.subscription import Listener
from skytether.wire.topic import ANY, Role, Topic

from ...session.topic_table import robot_table, spoken
from ..graph_base import GraphBase, nowhere
from ..graph_config import RobotGraphConfig
from ..ros.robot import RosRobot
from ..wheels_watch import WheelsWatch


@dataclass(frozen=True, slots=True)
class Ros1RobotConfig(RobotGraphConfig):
    """Where in its graph the robot's things are.

    Attributes:
        params: Handed to the service's graph.
        use_sim_time: Whether /clock tells the time; None: as the master says.
    """

    generation: ClassVar[Generation] = 1
    params: Collection[str] = ()
    use_sim_time: bool | None = None


class Ros1Robot(RosRobot):
    """Implements `skytether.robot.graphs.graph_base.Graph`, and tells how the agent is.

    Attributes:
        base: For the agent: readings and wheels.

    Args:
        config: What is where.
        node: Started.
    """

    encoding: Encoding = "ros1"

    def __init__(self, config: Ros1RobotConfig, node: Node) -> None:
        super().__init__(config)
        self._config: Ros1RobotConfig = config
        self._node = node
        self._port: Ros1Port | None = None
        self._wheels: Publication | None = None
        self._diagnostics: Publication | None = None
        send: Callable[[bytes], object] = nowhere
        if config.cmd_vel is not None:
            topic = resolve(config.cmd_vel, config.home)
            self._wheels = wheels = node.advertise(topic, Twist.TYPE, hash_of(Twist.TYPE, "ros1"), queue=1)

            def send(payload: bytes) -> None:
                wheels.publish(payload, boottime() + config.fresh_s)

        readings: dict[str, type[Message]] = {name: type_of(kind) for name, kind in config.readings.items()}
        self.base = GraphBase(readings, "ros1", send, idle_s=config.idle_s)
        own = config.names(())
        self._ends = [
            node.subscribe(own.own(name), cls.TYPE, hash_of(cls.TYPE, "ros1"), self._reader(name))
            for name, cls in readings.items()
        ]
        if config.wheels is not None:
            find = partial(node.master.publishers, config.wheels)
            self._watch = WheelsWatch(config.wheels, config.drivers or (node.name,), find)

    def _reader(self, name: str) -> Listener:
        return Listener(lambda data, _: self.base.put(name, data))

    @property
    def name(self) -> str:
        """PublishesDiagnostics: the node's."""
        return self._node.name

    def publish_diagnostics(self, type_name: str, topic: str, values: Mapping[str, Any]) -> None:
        """PublishesDiagnostics: from one thread."""
        if self._diagnostics is None:
            self._diagnostics = self._node.advertise(topic, type_name, hash_of(type_name, "ros1"))
        self._diagnostics.publish(encode_plain(type_name, values, "ros1"))

    def topics(self) -> list[Followed]:
        """How the service's topics, and the robot's own, stand in the graph now; from any thread."""
        found = [] if self._port is None else self._port.topics()
        known = {(topic.graph, topic.way) for topic in found}
        names, seen = self._config.names(()), self._node.publishers_by_topic()
        own = [taken(name, names.own(name), kind, seen) for name, kind in self._config.readings.items()]
        if self._wheels is not None and self._config.cmd_vel is not None:
            listeners = tuple(self._wheels.subscribers)
            own.append(Followed(self._config.cmd_vel, self._wheels.topic, Twist.TYPE, "to", listeners, bool(listeners)))
        return [*found, *(topic for topic in own if (topic.graph, topic.way) not in known)]

    def open(self, specs: Sequence[TopicSpec], command_topic: str) -> tuple[tuple[Topic, ...], Port]:
        specs = spoken(specs, "action")
        names, may = self._checked(specs, command_topic, self._config.readings)
        sim_time = self.sim_time()
        topics = (
            *robot_table(specs, self._offers(specs), encoding=self.encoding),
            *((CLOCK,) if sim_time and all(spec.name != CLOCK.name for spec in specs) else ()),
            *notes.topics(),
        )
        if self._port is not None:
            self._port.close()
        self._port = Ros1Port(
            self._node,
            Role.ROBOT,
            names,
            topics,
            skip=(command_topic,),
            permissions=may,
            params=self._config.params,
            sim_time=sim_time,
        )
        return topics, self._port

    def sim_time(self) -> bool:
        """Whether /clock tells the robot's time."""
        if self._config.use_sim_time is not None:
            return self._config.use_sim_time
        try:
            return self._node.master.get_param(SIM_TIME) is True
        except MasterError:
            return False

    def _types(self, names: Sequence[str]) -> dict[str, str]:
        try:
            types = self._node.master.topic_types() if names else {}
        except (MasterError, RefusedError):
            types = {}
        return {name: bridge_type(types.get(name, ANY)) for name in names}
