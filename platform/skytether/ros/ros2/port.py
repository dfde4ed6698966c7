"""A ROS 2 graph as a port of a bridge: topics and calls of its table as publishers, subscriptions and services.

What the peer has in ROS 1 bytes is turned into CDR and back, for the types that both know (`skytether.ros.convert`).
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Callable, Container, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Protocol, runtime_checkable

from skytether.bridge.calls import REQUEST, RESPONSE, CallError, Handler, call_names
from skytether.bridge.port import Publisher
from skytether.messages import DecodeError, Encoding, hash_of
from skytether.ros.convert import Convert, NoConversionError, converter
from skytether.wire.events import Connected, Event, MessageReceived
from skytether.wire.table import ANY
from skytether.wire.topic import Role, Topic

from .dialect import Endpoint, Kind
from .endpoints import Client, Handle, Publication
from .names import check_type, full_name
from .node import Ros2Node
from .qos import SERVICE, qos_of

_RIHS = "RIHS01_"
MAX_EARLY = 100
"""Messages of a topic that wait for the first session."""


@runtime_checkable
class Caller(Protocol):
    """The bridge, as far as calls need it."""

    def call(self, name: str, payload: bytes | memoryview, timeout: float) -> bytes:
        """See `skytether.bridge.Bridge.call`."""
        ...

    def answer(self, name: str, handler: Handler) -> None:
        """See `skytether.bridge.Bridge.answer`."""
        ...


@dataclass(slots=True)
class _Way:
    """One topic's way between graph and bridge.

    Attributes:
        handle: What we are on the graph for it.
        convert: From the sender's bytes to the taker's; None: they are the same.
        refusal: Why nothing goes this way; empty if it does.
        early: Messages of a reliable topic that wait until the peer told what it takes; None: it is known.
    """

    handle: Handle | None = None
    convert: Convert | None = None
    refusal: str = ""
    early: deque[bytes] | None = None


class Ros2Port:
    """Joins one session to a node of a ROS 2 graph; the node is the caller's, and may serve several ports.

    Args:
        node: Started or not.
        topics: This end's table.
        role: Which end this is.
        name_of: Name in the graph of a topic of the table (of a call its request); by default its own, in the root
            namespace.
        skip: Topics of the table that the port has nothing to do with.
        on_event: Called in the bridge's thread with connected, disconnected, moved and refused; must return at once.

    Raises:
        ValueError: A topic's name or type is none of ROS 2; the text names it.
    """

    encoding: Encoding = "cdr"

    def __init__(
        self,
        node: Ros2Node,
        topics: Iterable[Topic],
        role: Role,
        *,
        name_of: Callable[[str], str] = full_name,
        skip: Container[str] = (),
        on_event: Callable[[Event], object] | None = None,
    ) -> None:
        self._node = node
        self._role = role
        self._name_of = name_of
        self._on_event = on_event
        self._publisher: Publisher | None = None
        rows = {t.name: t for t in topics if t.name not in skip}
        self._calls = call_names(rows.values())
        self._takes_any = ANY in rows
        self._rows = {n: t for n, t in rows.items() if n != ANY}
        self._call_rows = {name: (rows[name + REQUEST], rows[name + RESPONSE]) for name in self._calls}
        self._ways = {name: self._way(row) for name, row in self._rows.items()}
        self._endpoints = {row.name: self._endpoint(row) for row in self._plain_rows()}
        self._services = {name: self._service(name) for name in self._calls}
        self._skip = skip

    def attach(self, publisher: Publisher) -> None:
        """Port: join the graph.

        Raises:
            TypeError: The table has calls, and the publisher is no bridge.
        """
        self._publisher = publisher
        for row in self._plain_rows():
            self._join_topic(row)
        if not self._calls:
            return
        if not isinstance(publisher, Caller):
            raise TypeError("a table with calls needs a bridge that makes and answers calls")
        for name, caller in self._calls.items():
            if caller is self._role:
                serve = partial(self._ask_peer, publisher, name)
                handle: Handle = self._node.serve(self._services[name], serve)
            else:
                client = self._node.client(self._services[name])
                handle = client
                publisher.answer(name, partial(self._ask_graph, client, name))
            self._ways[name + REQUEST].handle = handle

    def deliver(self, message: MessageReceived) -> None:
        """Port: publish what came from the peer."""
        way = self._ways.get(message.topic)
        if way is None or not isinstance(way.handle, Publication) or way.refusal:
            return
        payload = self._converted(message.topic, way, message.payload)
        if payload is not None:
            way.handle.put(payload)

    def notify(self, event: Event) -> None:
        """Port: see what was agreed with the peer."""
        if isinstance(event, Connected):
            for topic in event.topics:
                self._agree(topic)
        if self._on_event is not None:
            self._on_event(event)

    def close(self) -> None:
        """Leave the graph; the node stays."""
        for way in self._ways.values():
            if way.handle is not None:
                way.handle.close()

    @property
    def refusals(self) -> dict[str, str]:
        """Topics that are not carried, each with a sentence that says why."""
        ways = {name: way.refusal or (way.handle.refused if way.handle else "") for name, way in self._ways.items()}
        return {name: why for name, why in ways.items() if why}

    # --- topics ------------------------------------------------------------------------------------------------------

    def _plain_rows(self) -> list[Topic]:
        """Rows that are not half a call."""
        halves = set(itertools.chain.from_iterable((n + REQUEST, n + RESPONSE) for n in self._calls))
        return [row for name, row in self._rows.items() if name not in halves]

    def _endpoint(self, row: Topic) -> Endpoint:
        comes_in = row.direction.sender is not self._role
        kind = Kind.PUBLISHER if comes_in else Kind.SUBSCRIPTION
        qos = qos_of(row, publishes=comes_in)
        return Endpoint(kind, self._named(row.name), self._typed(row.name, row.type), self._hash(row), qos)

    def _join_topic(self, row: Topic) -> None:
        endpoint = self._endpoints[row.name]
        way = self._ways[row.name]
        if endpoint.kind is Kind.PUBLISHER:
            way.handle = self._node.publish(endpoint, waits=row.reliable)
        else:
            way.handle = self._node.subscribe(endpoint, partial(self._send, row.name, way))

    def _way(self, row: Topic) -> _Way:
        # The robot says what the bytes are, so its own end knows from the start.
        waits = row.reliable and self._role is Role.SERVICE
        return _Way(early=deque(maxlen=1 if row.latched else min(row.depth, MAX_EARLY)) if waits else None)

    def _send(self, topic: str, way: _Way, payload: bytes) -> None:
        """In a thread of Zenoh's: a message from the graph."""
        early = way.early
        if early is not None:
            early.append(payload)
            return
        converted = None if way.refusal else self._converted(topic, way, payload)
        if converted is None or self._publisher is None:
            return
        try:
            self._publisher.publish(topic, converted)
        except ValueError as error:  # too large
            self._node.report(f"size {topic}", str(error))

    def _converted(self, topic: str, way: _Way, payload: bytes | memoryview) -> bytes | memoryview | None:
        """A message as the other side wants it; None, told once a topic, if it cannot be read."""
        if way.convert is None:
            return payload
        try:
            return way.convert(payload)
        except DecodeError as error:
            self._node.report(f"convert {topic}", f"{topic}: a message was dropped, more may have been: {error}")
            return None

    def _agree(self, topic: Topic) -> None:
        """A topic as it was agreed with the peer: the robot says what the bytes are."""
        if topic.name in self._skip:
            return
        if topic.name not in self._rows:
            if not self._takes_any:
                return
            try:
                self._rows[topic.name], self._ways[topic.name] = topic, _Way()
                self._endpoints[topic.name] = self._endpoint(topic)
            except ValueError as error:
                self._ways[topic.name].refusal = str(error)
                self._node.report(f"name {topic.name}", str(error))
                return
            self._join_topic(topic)
        way = self._ways[topic.name]
        theirs: Encoding = "ros1" if topic.encoding == "ros1" else "cdr"
        comes_in = topic.direction.sender is not self._role
        source, target = (theirs, self.encoding) if comes_in else (self.encoding, theirs)
        way.convert, way.refusal = None, ""
        try:
            way.convert = converter(topic.type, source, target)
        except NoConversionError as error:
            way.refusal = f"{topic.name}: {error}"
            self._node.report(f"type {topic.name}", way.refusal)
        early, way.early = way.early, None
        for payload in early or ():
            self._send(topic.name, way, payload)

    # --- calls -------------------------------------------------------------------------------------------------------

    def _service(self, name: str) -> Endpoint:
        request = self._call_rows[name][0]
        kind = Kind.SERVER if self._calls[name] is self._role else Kind.CLIENT
        service = self._typed(name, request.type.removesuffix("_Request"))
        graph_name = self._named(name + REQUEST).removesuffix(REQUEST)
        return Endpoint(kind, graph_name, service, hash_of(service, "cdr"), SERVICE)

    def _ask_peer(self, bridge: Caller, name: str, request: bytes) -> bytes:
        """In a worker's thread of the node: a call from our graph is answered by the peer's."""
        timeout = self._call_rows[name][0].lifespan
        return self._exchange(name, request, lambda converted: bridge.call(name, converted, timeout))

    def _ask_graph(self, client: Client, name: str, request: bytes) -> bytes:
        """In a worker's thread of the bridge: a call from the peer is answered by our graph."""
        timeout = self._call_rows[name][0].lifespan
        return self._exchange(name, request, lambda converted: client.call(converted, timeout))

    def _exchange(self, name: str, request: bytes, ask: Callable[[bytes], bytes]) -> bytes:
        there, back = self._ways[name + REQUEST], self._ways[name + RESPONSE]
        if there.refusal or back.refusal:
            raise CallError(there.refusal or back.refusal)
        try:
            response = ask(there.convert(request) if there.convert else request)
            return back.convert(response) if back.convert else response
        except DecodeError as error:
            raise CallError(f"{name}: {error}") from error
        except ValueError as error:  # too large
            raise CallError(str(error)) from error

    # --- names -------------------------------------------------------------------------------------------------------

    def _named(self, name: str) -> str:
        try:
            return full_name(self._name_of(name))
        except ValueError as error:
            raise ValueError(f"topic '{name}': {error}") from error

    @staticmethod
    def _typed(name: str, type_name: str) -> str:
        try:
            return check_type(type_name)
        except ValueError as error:
            raise ValueError(f"topic '{name}': {error}") from error

    @staticmethod
    def _hash(row: Topic) -> str:
        return row.type_hash if row.type_hash.startswith(_RIHS) else hash_of(row.type, "cdr")
