"""A graph inside one process, and the port that joins it to a bridge."""

from __future__ import annotations

import threading
from collections import defaultdict
from collections.abc import Callable, Iterable
from functools import partial

from skytether.wire.events import Event, MessageReceived
from skytether.wire.topic import Role, Topic

from .port import Publisher

Payload = bytes | memoryview


class LocalGraph:
    """Publish and subscribe serialised messages by topic name, from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._subscribers: defaultdict[str, tuple[Callable[[Payload], object], ...]] = defaultdict(tuple)

    def publish(self, topic: str, payload: Payload) -> None:
        """Call every subscriber of the topic, in this thread. The payload must not change any more."""
        for callback in self._subscribers.get(topic, ()):
            callback(payload)

    def subscribe(self, topic: str, callback: Callable[[Payload], object]) -> Callable[[], None]:
        """Have a function called with each message of a topic, in the publisher's thread.

        Returns:
            A function that ends the subscription.
        """
        with self._lock:
            self._subscribers[topic] += (callback,)

        def unsubscribe() -> None:
            with self._lock:
                self._subscribers[topic] = tuple(c for c in self._subscribers[topic] if c is not callback)

        return unsubscribe


class GraphPort:
    """Joins a local graph to a bridge: sends the topics that this end publishes, publishes what arrives."""

    def __init__(
        self,
        graph: LocalGraph,
        topics: Iterable[Topic],
        role: Role,
        *,
        on_event: Callable[[Event], object] | None = None,
    ) -> None:
        """Prepare; the bridge attaches it.

        Args:
            graph: What to join.
            topics: This end's table.
            role: Which end this is.
            on_event: Called in the bridge's thread with connected, disconnected, moved and refused; must
                return at once.
        """
        self._graph = graph
        self._sends = [t.name for t in topics if t.direction.sender is role]
        self._on_event = on_event

    def attach(self, publisher: Publisher) -> None:
        for name in self._sends:
            self._graph.subscribe(name, partial(publisher.publish, name))

    def deliver(self, message: MessageReceived) -> None:
        self._graph.publish(message.topic, message.payload)

    def notify(self, event: Event) -> None:
        if self._on_event is not None:
            self._on_event(event)
