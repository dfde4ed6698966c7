"""A service as the bridge sees it: messages into mailboxes, the agreed table into the senders."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, cast, get_args

from skytether.messages import Encoding, Message, warm
from skytether.wire.events import Connected, Disconnected, Event, MessageReceived, PeerMoved, Refused
from skytether.wire.topic import Topic

from .service import Service
from .topics import Typed

if TYPE_CHECKING:
    from skytether.bridge.port import Publisher


class ServicePort:
    """Implements `Port` for one service. ``wake`` is called after every message and change of the connection."""

    def __init__(self, service: Service[Any], wake: Callable[[], None]) -> None:
        self.connected = False
        self._service = service
        self._wake = wake
        self._log = service.log
        self._table: dict[str, tuple[str, Encoding]] = {}
        self._cold: list[tuple[list[type[Message]], Encoding]] = []
        self._refused = ""

    def attach(self, publisher: Publisher) -> None:
        for sender in self._service.senders.values():
            sender.publisher = publisher

    def deliver(self, message: MessageReceived) -> None:
        agreed = self._table.get(message.topic)
        if agreed is None:
            return
        type_name, encoding = agreed
        mailbox = self._service.mailboxes.get(message.topic)
        if mailbox is not None:
            mailbox.put(message, encoding)
        elif self._service.anything is not None:
            self._service.anything.put(message, type_name, encoding)
        self._wake()

    def notify(self, event: Event) -> None:
        match event:
            case Connected(topics):
                self._log.info("connected; topics: %s", ", ".join(topic.name for topic in topics))
                self._agree(topics)
            case Disconnected(reason):
                self._log.info("disconnected: %s", reason)
                self._agree(())
            case PeerMoved(address):
                self._log.info("robot now speaks from %s", address)
            case Refused(reason) if reason != self._refused:
                self._refused = reason
                self._log.error("robot refused: %s", reason)
        self._wake()

    def settle(self) -> None:
        """From the service's thread, before a step: compile what a newly agreed encoding needs."""
        while self._cold:
            warm(*self._cold.pop())

    def _agree(self, topics: tuple[Topic, ...]) -> None:
        """Take over the table of a new connection; empty at its end."""
        table: dict[str, tuple[str, Encoding]] = {}
        for topic in topics:
            if topic.encoding in get_args(Encoding):
                table[topic.name] = (topic.type, cast(Encoding, topic.encoding))
            else:
                self._log.error("topic %s: the robot's encoding '%s' is not known here", topic.name, topic.encoding)
        self.connected = bool(topics)
        self._table = table
        for name, sender in self._service.senders.items():
            sender.encoding = table[name][1] if name in table else None
        for declared in self._service.declared:
            if isinstance(declared, Typed) and declared.topic in table:
                self._cold.append(([declared.cls], table[declared.topic][1]))
