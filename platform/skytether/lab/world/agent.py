"""A simulated robot as the robot agent sees one: a base that is read and written, and a graph of topics.

`WorldHardware` is for the robot's `Agent` what a base of ROS is: readings in, a velocity out, one tick of the
control loop after the other. `WorldGraph` is what a graph of ROS is: bytes in and out by topic name, through the same
`Port`; what a service publishes arrives here, what an experiment publishes (goals) goes to the service. Neither knows
which service it is.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial

from skytether.api.manifest import ANY_TOPIC, TopicSpec
from skytether.bridge.local import LocalGraph
from skytether.bridge.port import Port, Publisher
from skytether.messages import Encoding, Message, Twist, encode, hash_of
from skytether.robot.session.topic_table import Offer, robot_table, spoken
from skytether.wire.events import Event, MessageReceived
from skytether.wire.topic import Role, Topic

from .simulation import TICK, Readings, Robot, Simulation

CATCH_UP = 20
"""Ticks that are made at most at once after the control loop was held up: more would be a jump."""
_UNREAD = 2000
"""Messages of a robot that nobody reads; the newest stay. 20 s of /tf alone."""

Observer = Callable[[Simulation, Sequence[Readings]], None]
"""Called after each tick, in the thread that made it; must return soon."""


class Clockwork:
    """Moves one simulation in real time for all its robots, whoever asks first."""

    def __init__(self, simulation: Simulation, observers: Iterable[Observer] = ()) -> None:
        self.simulation = simulation
        self._observers = tuple(observers)
        self._lock = threading.Lock()
        self._began: float | None = None
        self._due = 0
        self._unread = [deque[tuple[str, Message]](maxlen=_UNREAD) for _ in simulation.robots]

    def read(self, index: int, now: float) -> Readings:
        """Advance the world to now [s of the robots' clock]; what this robot measured since its last call."""
        with self._lock:
            if self._began is None:
                self._began = now
            # Rounded, so that a tick of the control loop that is a little off is still one tick here.
            due = round((now - self._began) / TICK) + 1
            self._due = max(self._due, due - CATCH_UP)
            while self._due < due:
                self._due += 1
                found = self.simulation.tick(now)
                for unread, readings in zip(self._unread, found, strict=True):
                    unread.extend(readings)
                for observe in self._observers:
                    observe(self.simulation, found)
            unread = self._unread[index]
            readings = list(unread)
            unread.clear()
        return readings

    def write(self, index: int, twist: Twist) -> None:
        """Command a robot."""
        with self._lock:
            self.simulation.robots[index].write(twist)


class WorldHardware:
    """A robot of the world as the agent's hardware.

    Args:
        clockwork: Of the world.
        index: Of the robot.
        names: Topic names that differ from `Robot.topics`, as ``{"scan": "RosAria/laserscan"}``.
        graph: Gets all readings as well, for the services that read them as bytes.
    """

    def __init__(
        self,
        clockwork: Clockwork,
        index: int = 0,
        names: Mapping[str, str] | None = None,
        graph: WorldGraph | None = None,
    ) -> None:
        self._clockwork = clockwork
        self._index = index
        self._names = dict(names or {})
        self._graph = graph
        kinds = Robot.topics(clockwork.simulation.params)
        unknown = sorted(set(self._names) - set(kinds))
        if unknown:
            raise ValueError(f"a robot of the world has no topic {unknown[0]}; it has {', '.join(kinds)}")
        self.topics: Mapping[str, type[Message]] = {self._names.get(t, t): kind for t, kind in kinds.items()}
        if graph is not None:
            graph.offer(self.topics)

    def read(self, now: float) -> Iterable[tuple[str, Message]]:
        """Base: advance the world to now."""
        found = [(self._names.get(t, t), message) for t, message in self._clockwork.read(self._index, now)]
        if self._graph is not None:
            for topic, message in found:
                self._graph.publish(topic, message)
        return found

    def write(self, twist: Twist) -> None:
        """Base: what the wheels are to do until the next call."""
        self._clockwork.write(self._index, twist)


class WorldGraph:
    """A `skytether.robot.graphs.graph_base.Graph` in this process: what a ROS master is to a real robot.

    Args:
        encoding: Of all its messages.
    """

    def __init__(self, encoding: Encoding = "cdr") -> None:
        self.encoding: Encoding = encoding
        self._local = LocalGraph()
        self._session: _SessionPort | None = None
        self._offered: dict[str, str] = {}

    def offer(self, topics: Mapping[str, type[Message]]) -> None:
        """Name what will be published, for services that take any topic."""
        self._offered.update({name: kind.TYPE for name, kind in topics.items()})

    def open(self, specs: Sequence[TopicSpec], command_topic: str) -> tuple[tuple[Topic, ...], Port]:
        """Graph: join it for a new session. The velocity's topic is in the table, and the port never sees it."""
        specs = spoken(specs, None)
        rows = [row for spec in specs if spec.kind != "call" for row in spec.rows()]
        taken = {row.name: row.type for row in rows if row.direction == "in"}
        if taken.pop(ANY_TOPIC, None) is not None:
            taken = {**self._offered, **taken}
        offers = {name: Offer(kind, hash_of(kind, self.encoding), self.encoding) for name, kind in taken.items()}
        table = robot_table(specs, offers, encoding=self.encoding)
        if self._session is not None:
            self._session.end()
        self._session = _SessionPort(self._local, [topic for topic in table if topic.name != command_topic])
        return table, self._session

    def publish(self, topic: str, message: Message) -> None:
        """Say something in the graph: to the service, if it takes that, and to whoever listens here."""
        self._local.publish(topic, encode(message, self.encoding))

    def subscribe(self, topic: str, callback: Callable[[bytes | memoryview], object]) -> Callable[[], None]:
        """Hear a topic as bytes, in its publisher's thread; returns what ends it."""
        return self._local.subscribe(topic, callback)


class _SessionPort:
    """A `Port` of one session: sends what the robot publishes of its topics, publishes what arrives."""

    def __init__(self, local: LocalGraph, topics: Sequence[Topic]) -> None:
        self._local = local
        self._sends = [topic.name for topic in topics if topic.direction.sender is Role.ROBOT]
        self._ends: list[Callable[[], None]] = []

    def attach(self, publisher: Publisher) -> None:
        self._ends += [self._local.subscribe(name, partial(publisher.publish, name)) for name in self._sends]

    def deliver(self, message: MessageReceived) -> None:
        self._local.publish(message.topic, message.payload)

    def notify(self, event: Event) -> None:
        """Nobody here asks."""

    def end(self) -> None:
        """Send nothing more."""
        while self._ends:
            self._ends.pop()()
