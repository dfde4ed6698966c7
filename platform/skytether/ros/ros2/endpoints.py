"""What we are on a ROS 2 graph, one object each: publishers, subscriptions, service servers and clients.

They are made and closed from any thread; what Zenoh has of them is declared and taken back by the node's own thread
(`node`), whenever there is a session and again when a type's hash was learned.
"""

from __future__ import annotations

import hashlib
import itertools
import logging
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from math import inf
from typing import Any, Protocol

import zenoh
import zenoh.ext

from skytether.bridge.calls import CallError

from .attachment import GID_BYTES, Attachment, pull_attachment, push_attachment
from .dialect import Dialect, Endpoint

_log = logging.getLogger(__name__)

HEARTBEAT_S = 0.5
"""How often a transient-local publisher tells its newest sequence number, as ``rmw_zenoh_cpp`` does."""


class Host(Protocol):
    """The node, as its endpoints see it."""

    dialect: Dialect

    def changed(self) -> None:
        """Wake the node's thread."""
        ...

    def outbox(self, send: Callable[[], object], name: str) -> bool:
        """Have something sent that may have to wait; False if too much waits already."""
        ...

    def work(self, job: Callable[[], object]) -> bool:
        """Have something done that may take its time; False if too much is being done already."""
        ...


class Handle(ABC):
    """One endpoint of ours.

    Attributes:
        endpoint: What it is; its type hash may be learned later.
        refused: Why nothing is carried: a sentence, or empty.
        passed: Messages of a topic that were given on.
        dropped: Messages that could not be given on.
    """

    def __init__(self, host: Host, endpoint: Endpoint) -> None:
        self.endpoint = endpoint
        self.refused = ""
        self.passed = 0
        self.dropped = 0
        self.closed = False
        self._host = host
        self._gid = bytes(GID_BYTES)
        self._sequence = itertools.count(1)

    def close(self) -> None:
        """Leave the graph; from any thread, and again."""
        self.closed = True
        self._host.changed()

    def declare(self, session: zenoh.Session, token: str) -> list[Any]:
        """From the node's thread: become part of the graph. Returns what is to be undeclared."""
        self._gid = hashlib.sha256(token.encode()).digest()[:GID_BYTES]
        return self._declare(session)

    @abstractmethod
    def _declare(self, session: zenoh.Session) -> list[Any]: ...

    def retract(self) -> None:  # noqa: B027 - most have nothing to forget
        """From the node's thread: what was declared is about to go."""

    def _attachment(self) -> bytes | None:
        if not self._host.dialect.attaches:
            return None
        return push_attachment(Attachment(next(self._sequence), time.time_ns(), self._gid))


class Publication(Handle):
    """A publisher."""

    _publisher: zenoh.Publisher | zenoh.ext.AdvancedPublisher | None = None
    _kept: bytes | memoryview | None = None
    """The newest message of a transient-local topic, for when there is a publisher."""
    stuck = False
    unread_s = 0.0
    heard = True
    renewed = None
    lost = False
    left_at: float = inf
    heard_at: float = inf
    waits = False
    """Whether a message may wait for room in the outbox, instead of being dropped where Zenoh has none."""

    def __init__(self, host: Host, endpoint: Endpoint) -> None:
        super().__init__(host, endpoint)
        self._using = threading.RLock()
        """A publisher of Zenoh's must not be undeclared while another thread puts something."""

    def put(
        self, payload: bytes | memoryview, until: float = inf, renewed: int | None = None, *, first: bool = False
    ) -> bool:
        """Publish one serialised message; from any thread, returns at once. False if it was dropped."""
        del until, renewed, first  # nothing waits here
        if self.endpoint.qos.transient_local:
            self._kept = payload
        sent = self._publisher is not None and not self.refused
        if sent and self.waits:
            sent = self._host.outbox(lambda: self._send(payload), self.endpoint.name)
        elif sent:
            sent = self._send(payload)
        self.passed += sent
        self.dropped += not sent
        return sent

    def _send(self, payload: bytes | memoryview) -> bool:
        with self._using:
            if self._publisher is None:
                return False
            try:
                self._publisher.put(bytes(payload), attachment=self._attachment())
            except zenoh.ZError:  # the session is gone
                return False
        return True

    def _declare(self, session: zenoh.Session) -> list[Any]:
        endpoint, dialect = self.endpoint, self._host.dialect
        if "*" in dialect.key(endpoint):
            return []  # nobody has told the type's hash yet, so nobody listens
        congestion = zenoh.CongestionControl.BLOCK if self.waits else zenoh.CongestionControl.DROP
        reliability = zenoh.Reliability.RELIABLE if endpoint.qos.reliable else zenoh.Reliability.BEST_EFFORT
        if endpoint.qos.transient_local:
            self._publisher = zenoh.ext.declare_advanced_publisher(
                session,
                dialect.key(endpoint),
                congestion_control=congestion,
                reliability=reliability,
                cache=zenoh.ext.CacheConfig(max_samples=endpoint.qos.depth),
                sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=HEARTBEAT_S),
                publisher_detection=True,
            )
            if self._kept is not None:
                self._send(self._kept)
        else:
            self._publisher = session.declare_publisher(
                dialect.key(endpoint), congestion_control=congestion, reliability=reliability
            )
        return [self._publisher]

    def retract(self) -> None:
        with self._using:
            self._publisher = None


class Subscription(Handle):
    """A subscription; its function is called in a thread of Zenoh's, one message at a time."""

    def __init__(self, host: Host, endpoint: Endpoint, take: Callable[[bytes], object]) -> None:
        super().__init__(host, endpoint)
        self._on_message = take

    def _declare(self, session: zenoh.Session) -> list[Any]:
        key, qos = self._host.dialect.key(self.endpoint), self.endpoint.qos
        if not qos.transient_local:
            return [session.declare_subscriber(key, self._on_sample)]
        return [
            zenoh.ext.declare_advanced_subscriber(
                session,
                key,
                self._on_sample,
                history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=qos.depth),
                recovery=zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
                subscriber_detection=True,
            )
        ]

    def _on_sample(self, sample: zenoh.Sample) -> None:
        if sample.kind != zenoh.SampleKind.PUT or self.closed:
            return
        if self.refused:
            self.dropped += 1
            return
        self.passed += 1
        try:
            self._on_message(sample.payload.to_bytes())
        except Exception:  # Zenoh's thread must live on
            _log.exception("A message of %s was lost", self.endpoint.name)


class Server(Handle):
    """A service; its function answers, in threads of its own, and raises `CallError` to tell the client a reason."""

    def __init__(self, host: Host, endpoint: Endpoint, answer: Callable[[bytes], bytes]) -> None:
        super().__init__(host, endpoint)
        self._answer = answer

    def _declare(self, session: zenoh.Session) -> list[Any]:
        return [session.declare_queryable(self._host.dialect.key(self.endpoint), self._on_query, complete=True)]

    def _on_query(self, query: zenoh.Query) -> None:
        if self.refused:
            _fail(query, self.refused)
        elif not self._host.work(lambda: self._work(query)):
            _fail(query, f"{self.endpoint.name}: too many calls at the same time; try again later")

    def _work(self, query: zenoh.Query) -> None:
        asked = pull_attachment(query.attachment.to_bytes()) if query.attachment is not None else None
        try:
            response = self._answer(query.payload.to_bytes() if query.payload is not None else b"")
        except CallError as error:
            _fail(query, str(error))
            return
        except Exception as error:
            _log.exception("A call of %s failed", self.endpoint.name)
            _fail(query, f"{self.endpoint.name}: {type(error).__name__}")
            return
        attachment = None
        if asked is not None and self._host.dialect.attaches:
            attachment = push_attachment(Attachment(asked.sequence, time.time_ns(), asked.gid))
        try:
            with query:
                query.reply(query.key_expr, response, attachment=attachment)
        except zenoh.ZError as error:
            _log.warning("An answer of %s was lost: %s", self.endpoint.name, error)


class Client(Handle):
    """A client of a service."""

    _session: zenoh.Session | None = None

    def call(self, request: bytes, timeout: float) -> bytes:
        """Ask, and wait.

        Args:
            request: Serialised.
            timeout: Seconds.

        Raises:
            CallError: No answer; the text says why.
        """
        name, session, dialect = self.endpoint.name, self._session, self._host.dialect
        if self.refused:
            raise CallError(self.refused)
        key = dialect.key(self.endpoint)
        if session is None:
            raise CallError(f"{name}: the ROS 2 graph is out of reach")
        if "*" in key:
            raise CallError(f"{name}: no node of the ROS 2 graph offers this service")
        # Servers of rmw_zenoh are complete queryables; the bridge to DDS says nothing of that.
        target = zenoh.QueryTarget.ALL_COMPLETE if dialect.attaches else zenoh.QueryTarget.BEST_MATCHING
        try:
            replies = session.get(
                key,
                target=target,
                consolidation=zenoh.ConsolidationMode.NONE,
                payload=request,
                attachment=self._attachment(),
                timeout=timeout,
            )
            for reply in replies:
                if reply.ok is not None:
                    return reply.ok.payload.to_bytes()
                reason = reply.err.payload.to_bytes().decode(errors="replace") if reply.err is not None else ""
                if reason.lower() == "timeout":
                    raise CallError(f"{name}: no answer within {timeout:g} s")
                raise CallError(reason or f"{name}: failed without a reason")
        except zenoh.ZError as error:
            raise CallError(f"{name}: {error}") from error
        raise CallError(f"{name}: no node of the ROS 2 graph offers this service")

    def _declare(self, session: zenoh.Session) -> list[Any]:
        self._session = session
        return []

    def retract(self) -> None:
        self._session = None


def _fail(query: zenoh.Query, reason: str) -> None:
    try:
        with query:
            query.reply_err(reason.encode())
    except zenoh.ZError as error:
        _log.warning("'%s' could not be told: %s", reason, error)
