"""A service's graph of one ROS generation for robots of either: what a robot's bytes are, it says in the handshake.

Stands between the bridge and the graph's port, and is each to the other. Only a service's end needs it: the robot's
encoding is the one that both ends agree on.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Protocol, cast

from skytether.bridge.calls import REQUEST, RESPONSE, CallError, Handler
from skytether.bridge.port import Port, Publisher
from skytether.messages import DecodeError, Encoding
from skytether.wire.events import Connected, Event, MessageReceived
from skytether.wire.topic import Role, Topic

from . import notes
from .convert import Convert, NoConversionError, converter

_log = logging.getLogger(__name__)
MAX_EARLY = 100
"""Messages of a reliable topic that wait for the first robot to say what it takes."""


class _Caller(Publisher, Protocol):
    """The bridge, with its calls."""

    def call(self, name: str, payload: bytes | memoryview, timeout: float) -> bytes: ...

    def answer(self, name: str, handler: Handler) -> None: ...


@dataclass(slots=True)
class _Way:
    """One topic's way.

    Attributes:
        convert: From the sender's bytes to the taker's; None: they are the same.
        refusal: Why nothing goes this way; empty if it does.
        early: What waits for the robot; None: it has spoken, or what is too early is not worth to be kept.
    """

    convert: Convert | None = None
    refusal: str = ""
    early: deque[bytes] | None = None


class Translated:
    """A port around the port of a graph.

    Args:
        port: The graph's.
        own: The graph's encoding.
        topics: This end's table.
        say: Told each trouble once a topic; by default it is logged.
    """

    def __init__(
        self,
        port: Port,
        own: Encoding,
        topics: Iterable[Topic],
        *,
        say: Callable[[str], object] = _log.warning,
    ) -> None:
        self._port = port
        self._own = own
        self._report = say
        self._bridge: _Caller
        self._said: set[tuple[str, str]] = set()
        self._ways = {t.name: _Way(early=_early(t)) for t in topics}

    @property
    def refusals(self) -> dict[str, str]:
        """Topics that cannot be translated, each with a sentence that says why."""
        return {name: way.refusal for name, way in self._ways.items() if way.refusal}

    # --- Port, for the bridge ----------------------------------------------------------------------------------------

    def attach(self, publisher: Publisher) -> None:
        self._bridge = cast(_Caller, publisher)
        self._port.attach(self)

    def deliver(self, message: MessageReceived) -> None:
        payload = self._translated(message.topic, message.payload)
        if payload is not None:
            self._port.deliver(message if payload is message.payload else replace(message, payload=payload))

    def notify(self, event: Event) -> None:
        if isinstance(event, Connected):
            for topic in event.topics:
                self._agree(topic)
        self._port.notify(event)

    # --- the bridge, for the graph's port ----------------------------------------------------------------------------

    def publish(self, topic: str, payload: bytes | memoryview) -> bool:
        """See `Publisher.publish`."""
        way = self._ways.get(topic)
        early = way.early if way is not None else None
        if early is not None:
            early.append(bytes(payload))
            return True
        translated = self._translated(topic, payload)
        return translated is not None and self._bridge.publish(topic, translated)

    def count_dropped(self, topic: str, count: int) -> None:
        """See `Publisher.count_dropped`."""
        self._bridge.count_dropped(topic, count)

    def call(self, name: str, payload: bytes | memoryview, timeout: float) -> bytes:
        """See `Bridge.call`."""
        return self._exchange(name, bytes(payload), lambda request: self._bridge.call(name, request, timeout))

    def answer(self, name: str, handler: Handler) -> None:
        """See `Bridge.answer`."""
        self._bridge.answer(name, lambda request: self._exchange(name, request, handler))

    # --- translation -------------------------------------------------------------------------------------------------

    def _agree(self, topic: Topic) -> None:
        """The robot has said what a topic's bytes are."""
        way = self._ways.setdefault(topic.name, _Way())
        theirs: Encoding = "ros1" if topic.encoding == "ros1" else "cdr"
        there = topic.direction.sender is Role.SERVICE
        source, target = (self._own, theirs) if there else (theirs, self._own)
        way.convert, way.refusal = None, ""
        if topic.type != notes.TYPE:
            try:
                way.convert = converter(topic.type, source, target)
            except NoConversionError as error:
                way.refusal = f"{topic.name}: {error}"
                self._report_once(topic.name, "type", way.refusal)
        early, way.early = way.early, None
        for payload in early or ():
            self.publish(topic.name, payload)

    def _translated(self, topic: str, payload: bytes | memoryview) -> bytes | memoryview | None:
        """A message as the other side wants it; None, told once a topic, if that cannot be."""
        way = self._ways.get(topic)
        if way is None or (way.convert is None and not way.refusal):
            return payload
        try:
            return way.convert(payload) if way.convert is not None else None
        except DecodeError as error:
            self._report_once(topic, "bytes", f"{topic}: a message was dropped, more may have been: {error}")
            return None

    def _exchange(self, name: str, request: bytes, ask: Callable[[bytes], bytes]) -> bytes:
        there, back = (self._ways.get(name + part, _Way()) for part in (REQUEST, RESPONSE))
        if there.refusal or back.refusal:
            raise CallError(there.refusal or back.refusal)
        try:
            response = ask(there.convert(request) if there.convert else request)
            return back.convert(response) if back.convert else response
        except DecodeError as error:
            raise CallError(f"{name}: {error}") from error

    def _report_once(self, topic: str, kind: str, sentence: str) -> None:
        if (topic, kind) not in self._said:
            self._said.add((topic, kind))
            self._report(sentence)


def _early(topic: Topic) -> deque[bytes] | None:
    if topic.direction.sender is not Role.SERVICE or not topic.reliable:
        return None
    if topic.type == notes.TYPE or topic.name.endswith((REQUEST, RESPONSE)):
        return None
    return deque(maxlen=1 if topic.latched else min(topic.depth, MAX_EARLY))
