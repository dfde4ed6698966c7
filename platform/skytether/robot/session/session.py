"""One bridge session of the agent, as the control loop sees it: send readings, take commands, know what is up.

The bridge's thread puts in, the control loop takes out; neither ever waits for the other.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from itertools import count
from typing import Protocol

from skytether.bridge.port import Port, Publisher
from skytether.messages import Encoding, Message, encode
from skytether.wire.events import Connected, Disconnected, Event, MessageReceived, Refused
from skytether.wire.stats import SessionStats

_log = logging.getLogger(__name__)

_WAITING_COMMANDS = 16
"""The control loop takes them every 10 ms; more than these in one tick are old news."""


class Endpoint(Publisher, Protocol):
    """What the agent needs of `skytether.bridge.Bridge`."""

    def start(self) -> None:
        """Bind."""
        ...

    def set_peer(self, host: str, port: int) -> None:
        """Where the service is."""
        ...

    def stats(self) -> SessionStats:
        """Counters."""
        ...

    def stop(self) -> None:
        """Say goodbye and end."""
        ...


class LiveSession:
    """A `Port` that keeps the arrivals of one topic, with the number of the handshake that they belong to.

    Args:
        id: The session's, to tell it from the next.
        topics: What the robot's control loop may send in it.
        command_topic: What it waits for.
        epochs: Numbers of handshakes, shared with the sessions before and after it.
        encoding: Of its messages, both ways.
        graph: Port of the robot's graph, which takes every other message and is told every event.
        shared_topic: What the service tells other robots, which is not the graph's either; None: nothing.

    Attributes:
        said: The newest message of that topic, until somebody takes it.
    """

    def __init__(
        self,
        id: str,  # noqa: A002
        topics: frozenset[str],
        command_topic: str,
        epochs: count[int],
        *,
        encoding: Encoding = "cdr",
        graph: Port | None = None,
        shared_topic: str | None = None,
    ) -> None:
        self.id = id
        self.encoding = encoding
        self._graph = graph
        self.connected = False
        self.refused = ""
        """Why there is no session, if the service says so; one sentence."""
        self.bridge: Endpoint | None = None
        self.peer: tuple[str, int] | None = None
        self._topics = topics
        self._command_topic = command_topic
        self._shared_topic = shared_topic
        self.said: MessageReceived | None = None
        self._epochs = epochs
        self._epoch = next(epochs)
        self._arrived: deque[tuple[int, MessageReceived]] = deque()
        self._missed = self._told_missed = 0
        """Each is changed by one thread alone: the bridge's, and who takes."""

    def open(self, make: Callable[[Port], Endpoint], peer: tuple[str, int]) -> None:
        """Make the bridge and start it."""
        bridge = make(self)
        bridge.start()
        self.bridge, self.peer = bridge, peer

    def move(self, peer: tuple[str, int]) -> None:
        """Follow the service to another address."""
        if peer != self.peer and self.bridge is not None:
            self.bridge.set_peer(*peer)
            self.peer = peer

    def close(self) -> None:
        """End the bridge."""
        self.connected = False
        if self.bridge is not None:
            self.bridge.stop()

    def publish(self, topic: str, message: Message) -> None:
        """Send a reading if the service takes it; while there is no session that is refused, and counted."""
        if self.bridge is not None and topic in self._topics:
            self.bridge.publish(topic, encode(message, self.encoding))

    @property
    def commands(self) -> bool:
        """Whether any wait to be taken."""
        return self.connected and bool(self._arrived)

    def drain_commands(self) -> list[tuple[int, MessageReceived]]:
        """What arrived since the last call, with the number of its handshake, oldest first."""
        taken = []
        while self._arrived:
            taken.append(self._arrived.popleft())
        return taken

    def drain_missed(self) -> int:
        """How many were too many to wait, since the last call."""
        new = self._missed - self._told_missed
        self._told_missed += new
        return new

    def attach(self, publisher: Publisher) -> None:
        """Port: the graph sends through it."""
        if self._graph is not None:
            self._graph.attach(publisher)

    def deliver(self, message: MessageReceived) -> None:
        """Port: keep commands, and what is for other robots; the rest is the graph's."""
        if message.topic == self._command_topic:
            if len(self._arrived) >= _WAITING_COMMANDS:
                with suppress(IndexError):  # it was taken just now
                    self._arrived.popleft()
                    self._missed += 1
            self._arrived.append((self._epoch, message))
        elif message.topic == self._shared_topic:
            self.said = message
        elif self._graph is not None:
            self._graph.deliver(message)

    def notify(self, event: Event) -> None:
        """Port: know what is up."""
        if isinstance(event, Connected):
            self._epoch = next(self._epochs)
            self.connected, self.refused = True, ""
        elif isinstance(event, Disconnected):
            self.connected = False
        elif isinstance(event, Refused):
            self.refused = f"the service refused the session: {event.reason}"
            _log.error("%s", self.refused)
        if self._graph is not None:
            self._graph.notify(event)
