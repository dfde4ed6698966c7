"""The conversation around a handshake: what is said and answered, by which path, to which address (rule 1).

The messages themselves are made and read in `handshake`, when to speak first is decided in `reconnect`, and what new
keys begin is the session's business.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Hashable
from typing import NamedTuple

from ..codec.ciphers import HandshakeTags
from ..codec.packet import HELLO, SHARD_AT, WELCOME
from ..config import MIN_MTU
from ..events import Event, Refused
from ..path.path import Path, Transmit
from ..send.sender import Sender
from ..state.epoch import Epoch
from ..state.topic_counters import TopicCounters
from .handshake import MAX_REASON, NO_KEYS, HandshakeResponder, Hello, Outcome, Resume, cut
from .paths import Paths
from .reconnect import Reconnector

AMPLIFICATION = 3
"""Bytes of an answer for each that was asked with, for nobody knows yet who asks."""
MAX_RAW = 8
"""Handshake messages waiting to be sent: answers to a flood of repeated HELLOs stop here."""

Times = tuple[float, float, float]
"""t1, t2, t3 in seconds, the first by the robot's clock."""


class HandshakeMessage(NamedTuple):
    """A complete, not yet authenticated handshake message."""

    kind: int
    """Type of its packets."""
    common: bytes
    """Common part of their header."""
    message: bytes
    path: int
    """By which it came."""
    address: Hashable
    now: float


class Welcomed(NamedTuple):
    """The service's end has answered."""

    epoch: Epoch
    """That the handshake made."""
    times: Times | None
    """Of that round trip; None: nobody knows which HELLO was answered."""


class HandshakeDriver:
    """Handshakes of one end, on its paths.

    Args:
        responder: Of the service's end; None at the robot's.
        reconnector: Of the robot's end; the service's never speaks first.
        paths: Where to send.
        sender: Seals what is said under keys.
        counters: Of all topics, for those of a new epoch.
        tags: Of handshake packets that this end sends.
        events: Where refusals go.
        rejected: Counters of what is refused.
    """

    def __init__(
        self,
        responder: HandshakeResponder | None,
        reconnector: Reconnector,
        paths: Paths,
        sender: Sender,
        counters: TopicCounters,
        tags: HandshakeTags,
        events: deque[Event],
        rejected: Counter[str],
    ) -> None:
        self._responder = responder
        self._reconnector = reconnector
        self._paths = paths
        self._sender = sender
        self._counters = counters
        self._tags = tags
        self._events = events
        self._rejected = rejected
        self._refusal = ""
        """Latest reason told, so that it is told once."""
        self.waiting: deque[Transmit] = deque()
        """Packets on their way before everything else."""

    def send_hello(self, epoch: Epoch | None, last_heard: float, now: float) -> None:
        """The robot's end: ask for the service, or whether it still knows the keys in use."""
        held = None if epoch is None else epoch.ciphers
        hello = self._reconnector.next_hello(held, last_heard, now)
        if hello is not None:
            for path in self._paths:
                if path.peer is not None:
                    self._send(hello.common, hello.message, path, path.peer)
                if held is not None:
                    self._paths.ping(path, now)

    def handle_handshake(
        self, received: HandshakeMessage, epoch: Epoch | None, previous: Epoch | None
    ) -> Welcomed | None:
        """Take a complete, not yet authenticated handshake message.

        Args:
            received: It, and where it came from.
            epoch: Keys in use, if any.
            previous: Those before, if still kept.

        Returns:
            At the robot's end: that the service has answered, and with which keys.
        """
        if received.kind == HELLO and self._responder is not None:
            self._on_hello(self._responder, received, epoch, previous)
        elif received.kind == WELCOME and self._reconnector.hello is not None:
            return self._on_welcome(self._reconnector.hello, received)
        else:
            self._rejected["unasked"] += 1
        return None

    def done(self) -> None:
        """New keys are in use."""
        self._refusal = ""

    def _on_hello(
        self, responder: HandshakeResponder, asked: HandshakeMessage, epoch: Epoch | None, previous: Epoch | None
    ) -> None:
        held = NO_KEYS if epoch is None or epoch.spent else epoch.ciphers.resume
        taken = {e.id for e in (epoch, previous) if e is not None}
        answer = responder.answer(asked.common, asked.message, held, taken, asked.now)
        if isinstance(answer, str):
            self._rejected[answer] += 1
        elif isinstance(answer, Resume):
            for each in self._paths:
                self._paths.ping_soon(each, asked.now)
            self._resume(asked.path, asked.address, asked.now)
        else:
            if answer.outcome is not None and answer.epoch is None:
                answer.epoch = self._make_epoch(answer.outcome)
            if answer.reason:
                self._refuse(answer.reason)
            answer.asked(asked.address)
            most = AMPLIFICATION * len(asked.message)
            self._send(answer.common, answer.message, self._paths.choice.active, asked.address, most)

    def _on_welcome(self, hello: Hello, received: HandshakeMessage) -> Welcomed | None:
        welcome = hello.open(received.common, received.message)
        if welcome is None:
            self._rejected["welcome_forged"] += 1
            return None
        if welcome.outcome is None:
            self._refuse(welcome.reason)
            self._reconnector.refused(received.now)
            return None
        sole = hello.sent == 1  # else nobody knows which one was answered, and the first ping will tell more
        return Welcomed(self._make_epoch(welcome.outcome), welcome.times if sole else None)

    def _resume(self, path: int, address: Hashable, now: float) -> None:
        """Tell a robot that holds the keys, where it asks for them: that need not be where it was last heard."""
        known = self._paths.get(path) or self._paths.choice.active
        if address != known.address:
            self._paths.ping_to(address, known, now)

    def _refuse(self, reason: str) -> None:
        reason = "".join(c if c.isprintable() else "?" for c in reason[:MAX_REASON])  # the peer's words, for a log
        if reason != self._refusal:
            self._refusal = reason
            self._events.append(Refused(reason))

    def _make_epoch(self, outcome: Outcome) -> Epoch:
        send, receive = self._counters.topics(outcome.topics)
        return Epoch(outcome.epoch, outcome.ciphers, tuple(t for _, t in outcome.topics), send, receive, outcome.life)

    def _send(self, common: bytes, message: bytes, path: Path, address: Hashable, most: float = math.inf) -> None:
        """At most so many bytes: parity, which comes last, is left out first."""
        if len(self.waiting) >= MAX_RAW:
            return
        packets, size = cut(common, message, MIN_MTU - SHARD_AT, path.redundancy.parity, self._tags)
        if len(packets) > most:
            packets = packets[: int(most // size) * size]
        path.pacer.spend(len(packets))
        path.packets_sent += -(-len(packets) // size)
        path.bytes_sent += len(packets)
        self.waiting.append(Transmit(path.id, address, packets, size if len(packets) > size else None))
