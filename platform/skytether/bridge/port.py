"""The seam between the bridge and a graph: what a graph gives, and what it gets.

A graph is whatever publishes and subscribes: the mailboxes of a service, a simulation, a ROS master. The
bridge sees topic name, type name, type hash and serialised bytes; it never decodes a message.
"""

from __future__ import annotations

from typing import Protocol

from skytether.wire.events import Event, MessageReceived


class Publisher(Protocol):
    """The bridge as a graph sees it."""

    def publish(self, topic: str, payload: bytes | memoryview) -> bool:
        """Hand over one serialised message; safe from any thread, never blocks.

        Returns:
            False if it was dropped because no session is up. Messages of reliable topics wait for one.

        Raises:
            KeyError: The topic is not in this end's table, or this end does not send it.
            ValueError: The payload is larger than the session's largest message.
        """
        ...

    def count_dropped(self, topic: str, count: int) -> None:
        """Count messages that the graph could not hand over, for they came too quickly; safe from any thread."""
        ...


class Port(Protocol):
    """A graph as the bridge sees it. Messages and events come in the bridge's thread; calls must return at once."""

    def attach(self, publisher: Publisher) -> None:
        """Called once, by `Bridge.start` in its caller's thread, before the first message."""
        ...

    def deliver(self, message: MessageReceived) -> None:
        """Take one message from the peer."""
        ...

    def notify(self, event: Event) -> None:
        """Take any other event: connected, disconnected, moved, refused."""
        ...
