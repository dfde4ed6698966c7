"""A service as the bridge sees it: messages into mailboxes, the agreed table into the senders."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, cast, get_args

from skytether.messages import Encoding, Message, warm
from skytether.wire.events import Connected, Disconnected, Event, MessageReceived, PeerMoved, Refused
from skytether.wire.topic import Topic

from .any_topics import AnyTopics
from .calls import CallPublisher, Desk, Spawn, Threads
from .errors import CallError
from .service import Service
from .topics import Action, Answer, Call, Declared, Typed

if TYPE_CHECKING:
    from skytether.bridge.port import Publisher

_FIRST = {"topic": "", "call": "/request", "action": "/goal", "ros2_action": "/_action/send_goal/request"}
"""Of what carries a declaration, the topic that tells its encoding."""


def classes_of(declared: Declared) -> list[type[Message]]:
    """Messages that a declaration stands for."""
    if isinstance(declared, Typed):
        return [declared.cls]
    if isinstance(declared, Action):
        return declared.action.classes
    return [declared.srv.request, declared.srv.response] if isinstance(declared, Answer | Call) else []


class ServicePort:
    """Implements `Port` for one service.

    Args:
        service: The service.
        wake: Called after every message, call and change of the connection.
        spawn: Runs the service's own calls; threads unless given.
    """

    def __init__(self, service: Service[Any], wake: Callable[[], None], spawn: Spawn | None = None) -> None:
        self.connected = False
        self.desk = Desk(wake)
        for name, (srv, handler) in service.answers.items():
            self.desk.open(name, srv, handler)
        self._threads = Threads()
        self._spawn = spawn or self._threads
        self._service = service
        self._wake = wake
        self._log = service.log
        self._table: dict[str, tuple[str, Encoding]] = {}
        self._cold: list[tuple[list[type[Message]], Encoding]] = []
        self._refused = ""
        self._any = None if service.anything is None else AnyTopics(service.anything)

    def attach(self, publisher: Publisher) -> None:
        for sender in self._service.senders.values():
            sender.publisher = publisher
        if self._service.callers or self._service.answers:
            calling = cast(CallPublisher, publisher)
            for caller in self._service.callers.values():
                caller.publisher, caller.spawn = calling, self._spawn
            for name in self.desk.names:
                calling.answer(name, partial(self._answer, name))

    def deliver(self, message: MessageReceived) -> None:
        agreed = self._table.get(message.topic)
        if agreed is None:
            return
        _, encoding = agreed
        mailbox = self._service.mailboxes.get(message.topic)
        if mailbox is not None:
            mailbox.put(message, encoding)
        elif (asked_for := self._service.asked_for.get(message.topic)) is not None:
            self._service.inbox.put(asked_for, message.payload, encoding)
        elif self._any is not None:
            self._any.put(message, encoding)
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

    def settle(self, now: float) -> None:
        """From the service's thread, before a step: compile what a newly agreed encoding needs, and serve actions."""
        while self._cold:
            warm(*self._cold.pop())
        for server in self._service.actions:
            server.tick(now)
        self._service.inbox.work()

    def due(self) -> float:
        """When an action wants `settle` again [s of the monotonic clock]; inf without any."""
        return min((server.due() for server in self._service.actions), default=math.inf)

    def close(self) -> None:
        """No call is answered or made any more; before the bridge stops."""
        self.desk.close()
        self._threads.close()

    def _answer(self, name: str, request: bytes) -> bytes:
        """In a thread of the bridge: have the service's thread answer."""
        from skytether.bridge import CallError as Failed

        agreed = self._table.get(name + "/request")
        if agreed is None:
            raise Failed("the service does not know its encoding")
        try:
            return self.desk.ask(name, request, agreed[1]).result()
        except CallError as error:
            raise Failed(str(error)) from error

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
        if self._any is not None:
            self._any.agree(topics)
        for name, sender in self._service.senders.items():
            sender.encoding = table[name][1] if name in table else None
        for name, caller in self._service.callers.items():
            caller.encoding = table[name + "/request"][1] if name + "/request" in table else None
        for server in self._service.actions:
            server.renew()
        for declared in self._service.declared:
            row = table.get(declared.topic + _FIRST[declared.kind])
            if row is not None:
                self._cold.append((classes_of(declared), row[1]))
