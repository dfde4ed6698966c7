"""A ROS 1 graph as a port of the bridge: subscribes what this end sends, publishes what it gets, bytes as they are.

The same at both ends, the robot's and the service's. What this end sends is subscribed as soon as the bridge is there;
what it gets is published once both ends have agreed on it. Services are offered while the other end has them.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable, Collection, Iterable, Mapping
from functools import partial
from math import inf
from typing import Any, Protocol, cast

from skytether.bridge.calls import REQUEST, RESPONSE, CallError, call_names
from skytether.bridge.port import Publisher
from skytether.guard.clock import now as boottime
from skytether.messages import definition_of, hash_of
from skytether.ros import notes as graph_notes
from skytether.ros.followed import Followed
from skytether.ros.names import GraphNameError, Names, ros1_type
from skytether.ros.notes import NOTES, Notes, TypeNote
from skytether.ros.permissions import Access, Permissions
from skytether.ros.ros2.native.side.stalls import TURN_S, Stalls
from skytether.ros.static_tf import TOPIC as TF_STATIC
from skytether.ros.static_tf import StaticTransforms
from skytether.ros.velocities import VELOCITIES, HeldBack
from skytether.wire.events import Connected, Event, MessageReceived
from skytether.wire.topic import ANY, Direction, Role, Topic

from .followed import taken
from .master import MasterError, RefusedError
from .node import Node
from .publication import QUEUE, Publication
from .services import CallRefusedError, ServiceServer, ServiceType
from .subscription import Listener, PublisherInfo

_log = logging.getLogger(__name__)

CLOCK = Topic(
    "/clock",
    "rosgraph_msgs/msg/Clock",
    Direction.IN,
    encoding="ros1",
    priority=115,
    lifespan=0.2,
)
"""Carried to the service when the robot's time is a simulation's."""
SIM_TIME = "/use_sim_time"
SURVEY_S = 1.0
"""Between looks for services and parameters."""
_STATUS = "actionlib_msgs/msg/GoalStatusArray"
"""Latched by action servers, and repeated all the time."""
_EARLY = 16
"""Messages kept of a topic whose type the other end has not told yet."""
_CALL_S = 60.0
"""Longest that a service may take; shorter if its row's lifespan is."""


class Peer(Publisher, Protocol):
    """The bridge, with its calls."""

    def call(self, name: str, payload: bytes | memoryview, timeout: float) -> bytes:
        """See `Bridge.call`."""
        ...

    def answer(self, name: str, handler: Callable[[bytes], bytes]) -> None:
        """See `Bridge.answer`."""
        ...


class Ros1Port:
    """Joins one session to the node's graph.

    Args:
        node: Started.
        role: Which end this is.
        names: Names in the graph.
        topics: This end's table, with `skytether.ros.notes.topics`.
        skip: Topics that somebody else takes care of.
        permissions: What the other end may publish, call and offer here; None: everything.
        params: Names or namespaces of parameters that the other end gets.
        sim_time: Tell the other end that its time is a simulation's.
        on_notes: Called in the bridge's thread with what the other end tells; must return at once.
        on_event: The same with connected, disconnected, moved and refused.
        survey_s: Between looks for services and parameters.
    """

    def __init__(
        self,
        node: Node,
        role: Role,
        names: Names,
        topics: Iterable[Topic],
        *,
        skip: Collection[str] = (),
        permissions: Permissions | None = None,
        params: Collection[str] = (),
        sim_time: bool = False,
        on_notes: Callable[[Notes], None] = lambda _: None,
        on_event: Callable[[Event], object] = lambda _: None,
        survey_s: float = SURVEY_S,
    ) -> None:
        self._node = node
        self._role = role
        self._names = names
        self._permissions = permissions
        self._params = params
        self._sim_time = sim_time
        self._on_notes = on_notes
        self._on_event = on_event
        self._survey_s = survey_s
        table = tuple(topics)
        self._calls = call_names(table)
        parts = {name + part for name in self._calls for part in (REQUEST, RESPONSE)}
        apart = {*parts, *NOTES.values(), *skip, ANY}
        self._apart = apart
        self._rows = {t.name: t for t in table}
        self._agreed: dict[str, Topic] = {}
        self._sends = [t for t in table if t.direction.sender is role and t.name not in apart]
        self._peer: Peer
        self._lock = threading.Lock()
        self._publications: dict[str, Publication] = {}
        self._held_back: dict[str, HeldBack] = {}
        self._early: dict[str, deque[bytes | memoryview]] = {}
        self._servers: dict[str, ServiceServer] = {}
        self._ends: list[Callable[[], None]] = []
        self._learned: dict[str, TypeNote] = {}
        self._found: dict[str, ServiceType] = {}
        self._others = Notes()
        self._said: set[str] = set()
        self._closed = False
        self._ended = threading.Event()
        self._stalls = Stalls(boottime())
        self._survey_due = threading.Event()
        self._thread = threading.Thread(target=self._survey, name="ros1-survey", daemon=True)

    # --- Port ------------------------------------------------------------------------------------------------------

    def attach(self, publisher: Publisher) -> None:
        self._peer = cast(Peer, publisher)
        if any(topic.type in VELOCITIES for topic in self._sends):
            threading.Thread(target=self._turn, name="ros1-stalls", daemon=True).start()
        for topic in self._sends:
            self._listen(topic)
        for name, caller in self._calls.items():
            if caller is not self._role:
                self._peer.answer(name, partial(self._ask_graph, name))
        self._thread.start()

    def deliver(self, message: MessageReceived) -> None:
        publication = self._publications.get(message.topic)
        if publication is not None:
            row = self._agreed[message.topic]
            held_back = self._held_back.get(message.topic)
            if held_back is None:
                held_back = self._held_back[message.topic] = HeldBack(row)
            if held_back.is_late(message):
                self._log_once(held_back.reason)
            elif self._may(Access.PUBLISH, publication.topic):
                until = boottime() + row.lifespan if row.type in VELOCITIES else inf
                publication.publish(message.payload, until)
        elif message.topic == NOTES[self._other]:
            told = graph_notes.unpack(message.payload)
            if told is None:
                self._log_once("the other end told nothing about its graph that is understood here")
            else:
                self._receive_notes(told)
        elif message.topic in self._early:
            self._early[message.topic].append(message.payload)

    def notify(self, event: Event) -> None:
        self._on_event(event)
        if not isinstance(event, Connected):
            return
        for topic in event.topics:
            if topic.direction.sender is not self._role and topic.name not in self._apart:
                self._agreed[topic.name] = topic
                self._offer(topic)
        if NOTES[self._other] not in {t.name for t in event.topics}:
            for name in self._made:  # nobody tells whether it is there: the call will
                self._serve(name, ServiceType(self._service_type(name), ""))
        self._survey_due.set()

    def close(self) -> None:
        """Leave the graph; the node stays."""
        with self._lock:
            self._closed = True
            self._ended.set()
            ends, self._ends = self._ends, []
            publications, self._publications = self._publications, {}
            servers, self._servers = self._servers, {}
        self._survey_due.set()
        for end in ends:
            end()
        for publication in publications.values():
            self._node.unadvertise(publication)
        for server in servers.values():
            self._node.unserve(server)

    def topics(self) -> list[Followed]:
        """How each topic stands in the graph now; those that the other end gives are there once agreed."""
        seen = self._node.publishers_by_topic()
        found = []
        for row in self._sends:
            name = self._names.of(row.name)
            found.append(taken(row.name, name, row.type, seen))
        with self._lock:
            publications = dict(self._publications)
        for row in list(self._agreed.values()):
            name = self._names.of(row.name)
            publication = publications.get(row.name)
            listeners = tuple(publication.subscribers) if publication else ()
            refusal = self._permissions.refusal(Access.PUBLISH, name) if self._permissions is not None else ""
            quality = "latched" if row.latched else ""
            found.append(Followed(row.name, name, row.type, "to", listeners, bool(listeners), quality, refused=refusal))
        return found

    def subscribers(self, topic: str) -> list[str]:
        """Names of the nodes that listen to a topic of the bridge which is published here."""
        publication = self._publications.get(topic)
        return publication.subscribers if publication else []

    # --- topics ----------------------------------------------------------------------------------------------------

    def _listen(self, topic: Topic) -> None:
        """Subscribe one topic that this end sends."""
        name = self._names.of(topic.name)
        merge = StaticTransforms("ros1").merge if name == TF_STATIC else None

        def on_message(data: bytes, _: PublisherInfo) -> None:
            if topic.type in VELOCITIES and self._stalls.is_old(topic.name, None, boottime()):
                self._peer.count_dropped(topic.name, 1)
                self._log_once(f"{topic.name}: our end stood still; what came meanwhile is not taken")
                return
            try:
                self._peer.publish(topic.name, merge(data) if merge else data)
            except (KeyError, ValueError) as error:
                self._log_once(str(error))

        listener = Listener(on_message, partial(self._on_publisher, topic))
        self._ends.append(self._node.subscribe(name, topic.type, self._md5(topic), listener))

    def _turn(self) -> None:
        """Thread that sees this process stand still: what waited for it in the kernel is old."""
        while not self._ended.wait(TURN_S):
            self._stalls.turn(boottime())

    def _on_publisher(self, topic: Topic, info: PublisherInfo) -> None:
        """In the node's thread: learn the type if it is not known everywhere."""
        if info.latched and not topic.latched and topic.type != _STATUS:
            self._log_once(
                f"topic {topic.name} is latched by {info.caller}, but not in the manifest: who comes late at the other "
                "end does not get it; write reliable: true, latched: true there"
            )
        if hash_of(topic.type, "ros1") != info.md5:
            with self._lock:
                self._learned[topic.name] = TypeNote(info.type, info.md5, info.definition)
            self._survey_due.set()

    def _offer(self, topic: Topic) -> None:
        """Publish one topic that this end gets, once its type is known."""
        with self._lock:
            if self._closed or topic.name in self._publications:
                return
            note = self._others.types.get(topic.name)
            md5, definition = self._md5(topic), definition_of(topic.type, "ros1")
            if note is not None and ros1_type(topic.type) == ros1_type(note.type):
                md5, definition = note.md5, note.definition
            if not md5:
                self._early.setdefault(topic.name, deque(maxlen=_EARLY))
                return
            try:
                name = self._names.of(topic.name)
                if not self._may(Access.PUBLISH, name):
                    return
                queue = max(QUEUE, topic.depth)
                # What must arrive (a goal) may come just before the node that it is for has connected.
                hold = topic.lifespan if topic.reliable and not topic.latched else 0.0
                publication = self._node.advertise(
                    name, topic.type, md5, definition, latched=topic.latched, queue=queue, hold_s=hold
                )
            except (GraphNameError, ValueError) as error:
                self._log_once(f"topic {topic.name} cannot be published here: {error}")
                return
            for payload in self._early.pop(topic.name, ()):
                publication.publish(payload)
            self._publications[topic.name] = publication

    def _md5(self, topic: Topic) -> str:
        return topic.type_hash if len(topic.type_hash) == 32 else hash_of(topic.type, "ros1")

    # --- calls -----------------------------------------------------------------------------------------------------

    @property
    def _other(self) -> Role:
        return Role.SERVICE if self._role is Role.ROBOT else Role.ROBOT

    @property
    def _made(self) -> list[str]:
        """Calls that nodes of this graph make."""
        return [name for name, caller in self._calls.items() if caller is self._role]

    def _service_type(self, call: str) -> str:
        return ros1_type(self._rows[call + REQUEST].type.removesuffix("_Request"))

    def _timeout(self, call: str) -> float:
        return min(_CALL_S, self._rows[call + REQUEST].lifespan)

    def _serve(self, call: str, kind: ServiceType) -> None:
        """Offer a service of the other end in this graph; its type may be told anew."""
        with self._lock:
            if self._closed:
                return
            server = self._servers.get(call)
            if server is not None:
                server.kind = kind
                return
            timeout = self._timeout(call)
            try:
                name = self._names.of(call)
                if not self._may(Access.OFFER, name):
                    return
                self._servers[call] = self._node.serve(
                    name, kind, lambda request: self._peer.call(call, request, timeout)
                )
            except (GraphNameError, ValueError) as error:
                self._log_once(f"service {call} cannot be offered here: {error}")

    def _unserve(self, call: str) -> None:
        with self._lock:
            server = self._servers.pop(call, None)
        if server is not None:
            self._node.unserve(server)

    def _ask_graph(self, call: str, request: bytes) -> bytes:
        """In a thread of the bridge's calls: have a node of this graph answer the other end."""
        kind = self._found.get(call)
        try:
            name = self._names.of(call)
            if not self._may(Access.CALL, name):
                raise CallError(f"{name} is not called for the other end")
            return self._node.call_service(name, request, self._timeout(call), kind.md5 if kind else "")
        except (CallRefusedError, MasterError) as error:
            raise CallError(str(error)) from error

    # --- notes -----------------------------------------------------------------------------------------------------

    def _receive_notes(self, told: Notes) -> None:
        """In the bridge's thread: the other end's graph has changed."""
        self._others = told
        for name in list(self._early):
            if name in told.types:
                self._offer(self._agreed[name])
        for call in self._made:
            note = told.services.get(call)
            if note is None:
                self._unserve(call)
            elif ros1_type(note.type) != self._service_type(call):
                self._unserve(call)
                self._log_once(
                    f"service {call}: the other end has {note.type} with MD5 {note.md5}, but "
                    f"{self._service_type(call)} is wanted; it is left out"
                )
            else:
                self._serve(call, ServiceType(note.type, note.md5))
        self._on_notes(told)

    def _survey(self) -> None:
        """The port's own thread: look for services and parameters, and tell the other end what changed."""
        params: Mapping[str, Any] | None = None
        sent: Notes | None = None
        while not self._closed:
            self._survey_due.clear()
            try:
                if params is None:
                    params = self._read_params()
                self._find_services()
            except MasterError:
                pass  # the node says so
            if params is not None:
                services = {name: TypeNote(kind.type, kind.md5) for name, kind in self._found.items()}
                with self._lock:
                    mine = Notes(dict(self._learned), services, params)
                if mine != sent and not self._closed and self._peer.publish(NOTES[self._role], mine.pack()):
                    sent = mine
            self._survey_due.wait(self._survey_s)

    def _read_params(self) -> dict[str, Any]:
        """What is handed over; what is not set is named.

        Raises:
            MasterError: The master does not answer.
        """
        found: dict[str, Any] = {SIM_TIME: True} if self._sim_time else {}
        for name in self._params:
            try:
                found[name] = self._node.master.get_param(name)
            except RefusedError:
                self._log_once(f"parameter {name} is not set, so it is not handed over")
        return found

    def _find_services(self) -> None:
        """Which of the services that this end answers are there.

        Raises:
            MasterError: The master does not answer.
        """
        for call, caller in self._calls.items():
            if caller is self._role:
                continue
            try:
                name = self._names.of(call)
                found = self._node.find_service(name) if self._may(Access.CALL, name) else None
            except CallRefusedError as error:
                self._log_once(str(error))
                found = None
            if found is None:
                self._found.pop(call, None)
            else:
                self._found[call] = found[1]

    def _may(self, access: Access, name: str) -> bool:
        """Whether the other end may do that here; a refusal is named."""
        refusal = self._permissions.refusal(access, name) if self._permissions is not None else ""
        if refusal:
            self._log_once(refusal)
        return not refusal

    def _log_once(self, sentence: str) -> None:
        """Each once."""
        if sentence not in self._said and len(self._said) < 1000:
            self._said.add(sentence)
            _log.error("%s", sentence)
