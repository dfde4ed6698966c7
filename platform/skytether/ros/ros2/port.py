"""A ROS 2 graph as a port of a bridge: topics and calls of its table as publishers, subscriptions and services.

What a peer has in ROS 1 bytes is turned into CDR and back by a `skytether.ros.translate.Translated` around it.
"""

from __future__ import annotations

import itertools
import threading
from collections import deque
from collections.abc import Callable, Container, Iterable
from dataclasses import dataclass, field, replace
from functools import partial
from math import inf
from typing import Protocol, runtime_checkable

from skytether.bridge.calls import REQUEST, RESPONSE, CallError, Handler, call_names
from skytether.bridge.port import Publisher
from skytether.messages import Encoding, definition_of, hash_of
from skytether.ros import notes as graph_notes
from skytether.ros.followed import Followed
from skytether.ros.names import bridge_type
from skytether.ros.notes import NOTES, Notes, TypeNote
from skytether.ros.permissions import Access, Permissions
from skytether.ros.static_tf import TOPIC as STATIC_TF
from skytether.ros.static_tf import StaticTransforms
from skytether.ros.velocities import VELOCITIES, HeldBack
from skytether.wire.events import Connected, Event, MessageReceived
from skytether.wire.topic import ANY, Role, Topic

from .dialect import Endpoint, Kind
from .followed import followed
from .graph import learned_hash
from .names import check_type, full_name
from .qos import SERVICE, qos_of
from .seam import Client, GraphNode, Handle, Publication

SURVEY_S = 0.5
"""Between looks for topics whose type is not known yet."""
_EARLY = 16
"""Messages kept of a topic whose type the peer has not told yet."""
_RIHS = "RIHS01_"


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
        publication: The same, where we publish.
        refusal: Why nothing goes this way; empty if it does.
        early: What came before the peer has told its type.
        held_back: Which velocities of it were.
    """

    handle: Handle | None = None
    publication: Publication | None = None
    refusal: str = ""
    early: deque[MessageReceived] = field(default_factory=lambda: deque(maxlen=_EARLY))
    held_back: HeldBack | None = None


class Ros2Port:
    """Joins one session to a node of a ROS 2 graph; the node is the caller's, and may serve several ports.

    Args:
        node: Started or not.
        topics: This end's table. A topic of type `ANY` that this end sends is followed when somebody publishes it; with
            a row of `skytether.ros.notes.topics` the peer is told its type, and each that not everybody knows.
        role: Which end this is.
        name_of: Name in the graph of a topic of the table (of a call its request); by default its own, in the root
            namespace.
        skip: Topics of the table that the port has nothing to do with.
        permissions: What the peer may publish, call and offer here; None: everything.
        on_event: Called in the bridge's thread with connected, disconnected, moved and refused; must return at once.

    Raises:
        ValueError: A topic's name or type is none of ROS 2; the text names it.
    """

    encoding: Encoding = "cdr"

    def __init__(
        self,
        node: GraphNode,
        topics: Iterable[Topic],
        role: Role,
        *,
        name_of: Callable[[str], str] = full_name,
        skip: Container[str] = (),
        permissions: Permissions | None = None,
        on_event: Callable[[Event], object] | None = None,
    ) -> None:
        self._node = node
        self._role = role
        self._name_of = name_of
        self._permissions = permissions
        self._on_event = on_event
        self._publisher: Publisher | None = None
        rows = {t.name: t for t in topics if t.name not in skip}
        self._calls = call_names(rows.values())
        self._takes_any = ANY in rows
        self._tells = NOTES[role] in rows
        self._rows = {n: t for n, t in rows.items() if n not in (ANY, *NOTES.values())}
        self._call_rows = {name: (rows[name + REQUEST], rows[name + RESPONSE]) for name in self._calls}
        self._ways = {name: _Way() for name in self._rows}
        self._endpoints = {row.name: self._endpoint(row) for row in self._plain_rows() if row.type != ANY}
        self._late = {row.name: row for row in self._plain_rows() if row.type == ANY}
        """Topics of the table whose type nobody has told yet."""
        self._learned: dict[str, TypeNote] = {}
        self._services = {name: self._service(name) for name in self._calls}
        self._skip = skip
        self._lock = threading.Lock()
        self._closed = threading.Event()

    def attach(self, publisher: Publisher) -> None:
        """Port: join the graph.

        Raises:
            TypeError: The table has calls, and the publisher is no bridge.
        """
        self._publisher = publisher
        for row in self._plain_rows():
            if row.name not in self._late:
                self._join_topic(row)
        if self._late or self._tells:
            threading.Thread(target=self._survey, args=(publisher,), name="ros2-survey", daemon=True).start()
        if not self._calls:
            return
        if not isinstance(publisher, Caller):
            raise TypeError("a table with calls needs a bridge that makes and answers calls")
        for name, caller in self._calls.items():
            access = Access.OFFER if caller is self._role else Access.CALL
            if not self._may(access, name + REQUEST, self._services[name].name):
                if access is Access.CALL:
                    publisher.answer(name, partial(_refuse, self._ways[name + REQUEST].refusal))
                continue
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
        if message.topic in NOTES.values():
            self._receive_notes(graph_notes.unpack(message.payload) or Notes())
            return
        way = self._ways.get(message.topic)
        if way is not None and message.topic in self._late:
            way.early.append(message)
        if way is None or way.publication is None:
            return
        if self._may(Access.PUBLISH, message.topic, way.publication.endpoint.name):
            held_back = way.held_back
            if held_back is None:
                held_back = way.held_back = HeldBack(self._rows[message.topic])
            held = held_back.holds
            if held_back.is_late(message):
                way.publication.dropped += 1
                self._node.report(f"late {message.topic}", held_back.reason)
            else:
                if held:
                    self._node.settle(f"late {message.topic}")
                way.publication.put(message.payload)

    def notify(self, event: Event) -> None:
        """Port: see what was agreed with the peer."""
        if isinstance(event, Connected):
            for topic in event.topics:
                self._agree(topic)
        if self._on_event is not None:
            self._on_event(event)

    def close(self) -> None:
        """Leave the graph; the node stays."""
        with self._lock:
            self._closed.set()
        for way in self._ways.values():
            if way.handle is not None:
                way.handle.close()

    @property
    def refusals(self) -> dict[str, str]:
        """Topics that are not carried, each with a sentence that says why."""
        ways = {name: way.refusal or (way.handle.refused if way.handle else "") for name, way in self._ways.items()}
        return {name: why for name, why in ways.items() if why}

    def topics(self) -> list[Followed]:
        """How each topic of the table stands in the graph now; those that the peer named late are there once named."""
        found = []
        for name, endpoint in list(self._endpoints.items()):
            way = self._ways[name]
            found.append(followed(self._node, name, endpoint, way.handle, way.refusal))
        return found

    # --- topics ------------------------------------------------------------------------------------------------------

    def _plain_rows(self) -> list[Topic]:
        """Rows that are not half a call."""
        halves = set(itertools.chain.from_iterable((n + REQUEST, n + RESPONSE) for n in self._calls))
        return [row for name, row in self._rows.items() if name not in halves]

    def _endpoint(self, row: Topic) -> Endpoint:
        comes_in = row.direction.sender is not self._role
        kind = Kind.PUBLISHER if comes_in else Kind.SUBSCRIPTION
        qos = qos_of(row, publishes=comes_in)
        type_name = self._typed(row.name, row.type)
        return Endpoint(kind, self._named(row.name), type_name, self._hash(row), qos, priority=row.priority)

    def _join_topic(self, row: Topic) -> None:
        endpoint = self._endpoints[row.name]
        way = self._ways[row.name]
        if endpoint.kind is Kind.PUBLISHER:
            if self._may(Access.PUBLISH, row.name, endpoint.name):
                every = row.reliable or row.depth > 1  # not only the newest
                fresh_s = row.lifespan if endpoint.type in VELOCITIES else inf
                way.handle = way.publication = self._node.publish(endpoint, waits=every, fresh_s=fresh_s)
        else:
            send, lose = partial(self._send, row.name), partial(self._lose, row.name)
            if endpoint.name == STATIC_TF:
                merge = StaticTransforms(self.encoding).merge
                way.handle = self._node.subscribe(endpoint, lambda payload: send(merge(payload)), lose=lose)
            else:
                way.handle = self._node.subscribe(endpoint, send, lose=lose)

    def _send(self, topic: str, payload: bytes) -> None:
        """In a thread of the node's: a message from the graph."""
        if self._publisher is None:
            return
        try:
            self._publisher.publish(topic, payload)
        except ValueError as error:  # too large
            self._node.report(f"size {topic}", str(error))

    def _lose(self, topic: str, count: int) -> None:
        """In a thread of the node's: messages from the graph that came too quickly."""
        if self._publisher is not None:
            self._publisher.count_dropped(topic, count)

    def _agree(self, topic: Topic) -> None:
        """A topic that was agreed with the peer: a row for any takes what it names."""
        known = topic.name in self._rows and topic.name not in self._late
        if known or not self._takes_any or topic.name in self._skip or topic.name in NOTES.values():
            return
        self._rows[topic.name], self._ways[topic.name] = topic, _Way()
        if topic.type == ANY:
            self._late[topic.name] = topic
        else:
            self._late.pop(topic.name, None)
            self._name(topic)

    def _name(self, topic: Topic) -> None:
        """Join a topic whose type was told only now."""
        self._rows[topic.name] = topic
        try:
            self._endpoints[topic.name] = self._endpoint(topic)
        except ValueError as error:
            self._ways[topic.name].refusal = str(error)
            self._node.report(f"name {topic.name}", str(error))
            return
        self._join_topic(topic)

    # --- notes -------------------------------------------------------------------------------------------------------

    def _receive_notes(self, told: Notes) -> None:
        """In the bridge's thread: the peer knows types that it did not know when the session began."""
        for name, note in told.types.items():
            row = self._late.pop(name, None)
            if row is not None:
                self._name(replace(row, type=bridge_type(note.type), type_hash=note.md5))
                early = self._ways[name].early
                while early:
                    self.deliver(early.popleft())

    def _survey(self, publisher: Publisher) -> None:
        """Thread that looks for late topics, and tells the peer types that not everybody knows."""
        sent: Notes | None = None
        told = {row.name for row in self._plain_rows() if row.direction.sender is self._role and not _known(row)}
        answers = [name for name, caller in self._calls.items() if caller is not self._role]
        services = {name: TypeNote(self._services[name].type, "") for name in answers}
        while not self._closed.is_set():
            for row in list(self._late.values()):
                self._find(row)
            for name in told - set(self._late):
                self._learn(name)
            mine = Notes(dict(self._learned), services)
            if self._tells and mine != sent and publisher.publish(NOTES[self._role], mine.pack()):
                sent = mine
            self._closed.wait(SURVEY_S)

    def _find(self, row: Topic) -> None:
        """Follow a topic of which no type was known, if somebody publishes it now."""
        publishers = self._node.endpoints(self._named(row.name), Kind.PUBLISHER)
        with self._lock:
            if publishers and not self._closed.is_set():
                del self._late[row.name]
                self._name(replace(row, type=publishers[0].type))

    def _learn(self, name: str) -> None:
        """What the graph knows of a topic's type; ROS 2 Humble knows no hash."""
        endpoint = self._endpoints.get(name)
        known = self._learned.get(name)
        if endpoint is None or (known is not None and known.md5):
            return
        publishers = self._node.endpoints(endpoint.name, Kind.PUBLISHER)
        text = self._node.definition(endpoint.type) if publishers else None
        if text is not None:
            type_hash = endpoint.type_hash or learned_hash(endpoint, publishers)
            self._learned[name] = TypeNote(endpoint.type, type_hash, text)

    # --- calls -------------------------------------------------------------------------------------------------------

    def _service(self, name: str) -> Endpoint:
        request = self._call_rows[name][0]
        kind = Kind.SERVER if self._calls[name] is self._role else Kind.CLIENT
        service = self._typed(name, request.type.removesuffix("_Request"))
        graph_name = self._named(name + REQUEST).removesuffix(REQUEST)
        return Endpoint(kind, graph_name, service, self._hash(replace(request, type=service)), SERVICE)

    def _ask_peer(self, bridge: Caller, name: str, request: bytes) -> bytes:
        """In a worker's thread of the node: a call from our graph is answered by the peer's."""
        timeout = self._call_rows[name][0].lifespan
        return _told(lambda: bridge.call(name, request, timeout))

    def _ask_graph(self, client: Client, name: str, request: bytes) -> bytes:
        """In a worker's thread of the bridge: a call from the peer is answered by our graph."""
        if not self._may(Access.CALL, name + REQUEST, client.endpoint.name):
            raise CallError(self._ways[name + REQUEST].refusal)
        timeout = self._call_rows[name][0].lifespan
        return _told(lambda: client.call(request, timeout))

    def _may(self, access: Access, row: str, name: str) -> bool:
        """Whether the peer may do that here; a refusal is named once, and kept with the row."""
        refusal = self._permissions.refusal(access, name) if self._permissions is not None else ""
        if refusal:
            self._ways[row].refusal = refusal
            self._node.report(f"permission {access} {name}", refusal)
        return not refusal

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


def _known(row: Topic) -> bool:
    """Whether everybody knows the type."""
    return bool(row.type_hash and definition_of(row.type, "cdr"))


def _refuse(why: str, _: bytes) -> bytes:
    """Answer of a call that is not made."""
    raise CallError(why)


def _told(ask: Callable[[], bytes]) -> bytes:
    """What was asked; a request that is too large is a failure of the call."""
    try:
        return ask()
    except ValueError as error:
        raise CallError(str(error)) from error
