"""A robot that is a graph: its readings come from topics, its wheels listen to one. Common to all kinds of graph.

Two ways lead through such a robot. What the service takes in and gives out goes between graph and bridge as bytes
(`Graph`). What the robot's own control needs goes through `GraphBase`: the newest reading of each topic, decoded once a
tick, and the velocity to the wheels, which has passed the supervisor.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

from skytether.api.manifest import TopicSpec
from skytether.bridge.port import Port
from skytether.messages import DecodeError, Encoding, Message, Twist, decode, encode
from skytether.ros.followed import Followed
from skytether.ros.names import Names, resolve
from skytether.wire.topic import Topic

from ..control.control_loop import RobotHardware, WheelsStandError

_log = logging.getLogger(__name__)

IDLE_S = 1.0
"""How long a standstill is told again and again before the wheels' topic is left to others (a joystick)."""


class Graph(Protocol):
    """The robot's graph, as the agent sees it."""

    encoding: Encoding
    """Of all messages of the robot's sessions."""

    def open(self, specs: Sequence[TopicSpec], command_topic: str) -> tuple[tuple[Topic, ...], Port]:
        """Join the graph for a new session; the port of the session before is ended.

        Args:
            specs: The service's topics.
            command_topic: The one that the agent keeps for itself: it must be in the table, and the port never sees it.

        Returns:
            The robot's topic table, and what sends and takes its messages.

        Raises:
            ValueError: A topic cannot be in this graph; the text names it.
        """
        ...


@runtime_checkable
class TellsTopics(Protocol):
    """A graph that knows how its topics stand."""

    def topics(self) -> list[Followed]:
        """Each topic of the service and of the robot's own control; from any thread, never waits."""
        ...


class RobotGraph(Graph, Protocol):
    """A graph that has the robot's own readings and wheels, too."""

    @property
    def base(self) -> RobotHardware:
        """Readings and wheels, for the agent; a `GraphBase` does."""
        ...


@runtime_checkable
class PublishesDiagnostics(Protocol):
    """A graph in which people look for how the agent is (REP 107)."""

    @property
    def name(self) -> str:
        """The agent's in the graph."""
        ...

    def publish_diagnostics(self, type_name: str, topic: str, values: Mapping[str, Any]) -> None:
        """Publish a message, given as `skytether.messages.encode_plain` takes it. Returns at once."""
        ...


class GraphBase:
    """A `RobotHardware` whose readings are put in by the graph's threads, and whose wheels are a topic.

    Args:
        readings: What the robot's own control reads, by name.
        encoding: Of the readings, and of the velocity.
        send: Publishes a serialised velocity; must return at once.
        make: Turns the velocity into the message that the wheels take.
        idle_s: See `IDLE_S`; None: a standstill is told for ever.
        heard: Whether the wheels hear what is sent; as long as they do not, a standstill is told again and again,
            whatever the velocity. It is an error once ``send`` has returned true for it.
    """

    def __init__(
        self,
        readings: Mapping[str, type[Message]],
        encoding: Encoding,
        send: Callable[[bytes], object],
        *,
        make: Callable[[Twist], Message] = lambda twist: twist,
        idle_s: float | None = IDLE_S,
        heard: Callable[[], bool] = lambda: True,
    ) -> None:
        self.topics: Mapping[str, type[Message]] = dict(readings)
        self._encoding = encoding
        self._send = send
        self._make = make
        self._idle_s = idle_s
        self._heard = heard
        self._now = 0.0
        self._stood_since: float | None = None
        self._lock = threading.Lock()
        self._waiting: dict[str, bytes | memoryview] = {}
        self._undecodable: set[str] = set()

    def put(self, name: str, payload: bytes | memoryview) -> None:
        """From any thread: a message of one of the readings came; the newest wins."""
        with self._lock:
            self._waiting[name] = payload

    def read(self, now: float) -> Iterable[tuple[str, Message]]:
        """RobotHardware: what came since the last tick.

        Bytes that are no such message are named once a topic, and left out.
        """
        self._now = now
        with self._lock:
            waiting, self._waiting = self._waiting, {}
        found: list[tuple[str, Message]] = []
        for name, payload in waiting.items():
            try:
                found.append((name, decode(self.topics[name], payload, self._encoding)))
            except DecodeError as error:
                if name not in self._undecodable:
                    self._undecodable.add(name)
                    _log.error("reading %s is not used: %s", name, error)
        return found

    def write(self, twist: Twist) -> None:
        """RobotHardware: tell the wheels; a standstill that lasts is not told any more."""
        heard = self._heard()
        if twist != _STANDSTILL:
            self._stood_since = None
        elif self._stood_since is None:
            self._stood_since = self._now
        elif self._idle_s is not None and self._now - self._stood_since > self._idle_s and heard:
            return
        told = twist if heard else _STANDSTILL  # who begins to hear is to hear how the velocity begins, too
        try:
            taken = self._send(encode(self._make(told), self._encoding))
        except Exception:
            self._stood_since = None  # a standstill lasts from when the wheels were told of it
            raise
        if taken and told != twist:
            raise WheelsStandError("the wheels are told to stand until their node listens and hears us")


_STANDSTILL = Twist()


def nowhere(_: bytes) -> None:
    """Where velocities go that are not this graph's."""


def protected_names(names: Names, home: str, wheels: Iterable[str], readings: Iterable[str]) -> dict[str, str]:
    """What no service may publish in a robot's graph, gate or not: why, by absolute name.

    Args:
        names: The robot's own.
        home: Their namespace.
        wheels: What the wheels listen to.
        readings: What the robot's own controller reads.
    """
    found = {name: "the robot's own controller reads it" for given in readings for name in _both(given, names, home)}
    found |= {
        name: "the wheels listen to it; a service drives by its command topic alone, past the supervisor"
        for given in wheels
        for name in _both(given, names, home)
    }
    return found


def _both(name: str, names: Names, home: str) -> tuple[str, str]:
    """With its remapping and without."""
    return names.own(name), resolve(name, home)
