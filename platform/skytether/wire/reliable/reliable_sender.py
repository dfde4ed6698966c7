"""The sending end of a reliable topic (rule 7): every message until it is acknowledged, or given up as too old.

Messages of a reliable topic are sealed and sent as all others are, at the topic's own priority, and start with a
prefix: their sequence number, and how many numbers below it the sender has not given up. A message is sent again when
it is not acknowledged in time: a small one sealed anew, a large one shard by shard (`selective_repeat`). Both ends
outlive handshakes. The sender's numbers go on for as long as its end lives, so a peer that lives on takes nothing
twice; a peer that was restarted begins with the lowest number that the sender has not given up.
"""

from __future__ import annotations

import heapq
import math
from collections import deque

from ..codec.compression import original_size
from ..codec.frames import Ack
from ..codec.plaintext import PREFIX
from ..measure.counters import Outbound
from ..measure.rtt import RttEstimator
from ..topic import Topic
from .reliable_receiver import WINDOW, WINDOW_BYTES
from .selective_repeat import SelectiveRepeat

RESEAL_AFTER = 6
"""Reminders without an answer after which a large message is sent anew from the start: the peer may have taken its
number for an old one."""
NUMBER_SPAN = 32_768
"""Messages sealed since, after which a large message is sent anew: half of the peer's replay window."""


class PendingMessage:
    """One message until it is acknowledged or expired."""

    __slots__ = ("attempts", "deadline", "due", "held", "payload", "published_at", "queued", "sequence", "shards")

    def __init__(self, payload: bytes, published_at: float, deadline: float) -> None:
        self.payload = payload
        self.published_at = published_at
        self.deadline = deadline
        self.sequence = -1
        """Given when it is first sent."""
        self.shards: SelectiveRepeat | None = None
        """A large message's shards, sealed under the keys in use."""
        self.attempts = 0
        """In vain, since the peer was last heard of it."""
        self.due = math.inf
        """When to send it again."""
        self.held = False
        """The peer has it, but waits for one before it."""
        self.queued = False
        """It is to be sent."""


class ReliableSender:
    """The sending end of a reliable topic.

    Args:
        topic: Its row.
        counters: Its counters.
        rtt: Of the session.
    """

    __slots__ = (
        "_again", "_in_flight", "_in_flight_bytes", "_kept", "_next", "_rtt", "_timers", "_waiting", "_waiting_bytes",
        "counters", "forward_at", "index", "queued", "topic",
    )  # fmt: skip

    def __init__(self, topic: Topic, counters: Outbound, rtt: RttEstimator) -> None:
        self.topic = topic
        self.counters = counters
        self.index: int | None = None
        """Of the topic, in the epoch in use; None while there is none, or the peer does not take the topic."""
        self.queued = False
        """Whether the send queue has it."""
        self.forward_at = math.inf
        """When to tell the peer the lowest number that is not given up."""
        self._rtt = rtt
        self._next = 0
        self._waiting: deque[PendingMessage] = deque()
        """Never sent."""
        self._waiting_bytes = 0
        self._in_flight: dict[int, PendingMessage] = {}
        """Sent and not acknowledged, by rising number."""
        self._in_flight_bytes = 0
        self._again: deque[PendingMessage] = deque()
        """To be sent again."""
        self._timers: list[tuple[float, int]] = []
        """Heap of due times and numbers; those that changed since are skipped."""
        self._kept: PendingMessage | None = None
        """The newest message of a latched topic."""

    @property
    def base(self) -> int:
        """Lowest number that is not given up or acknowledged."""
        return next(iter(self._in_flight), self._next)

    @property
    def ready(self) -> bool:
        """Whether `next` has something."""
        return self.index is not None and bool(self._again or (self._waiting and self._room()))

    @property
    def used(self) -> int:
        """Payload bytes kept."""
        kept = self._kept
        landed = kept is not None and kept.sequence >= 0 and kept.sequence not in self._in_flight
        return self._in_flight_bytes + self._waiting_bytes + (len(kept.payload) if kept is not None and landed else 0)

    @property
    def idle(self) -> bool:
        """Whether there is nothing to wait for."""
        return not self._in_flight and not self._waiting and self.forward_at == math.inf

    @property
    def due(self) -> float:
        """When to call `handle_timer`."""
        due = self._timers[0][0] if self._timers else math.inf
        for pending in (next(iter(self._in_flight.values()), None), self._waiting[0] if self._waiting else None):
            if pending is not None and pending.deadline < due:
                due = pending.deadline
        return min(due, self.forward_at)

    def put(self, payload: bytes, now: float, room: int) -> bool:
        """Take a message.

        Args:
            payload: Its bytes.
            now: Time of publishing.
            room: Bytes that may be kept in addition.

        Returns:
            False (counted as replaced) if there is no room for it.
        """
        topic = self.topic
        full = topic.depth > 1 and len(self._in_flight) + len(self._waiting) >= topic.depth
        if full or len(payload) > room:
            self.counters.replaced += 1
            return False
        if topic.depth == 1 and self._waiting:
            self._waiting_bytes -= len(self._waiting.pop().payload)
            self.counters.replaced += 1
        pending = PendingMessage(payload, now, math.inf if topic.latched else now + topic.lifespan)
        if topic.latched:
            if self._kept is not None:  # as mortal as others from now on
                self._kept.deadline = min(self._kept.deadline, self._kept.published_at + topic.lifespan)
            self._kept = pending
        self._waiting.append(pending)
        self._waiting_bytes += len(payload)
        return True

    def pause(self) -> None:
        """No keys are in use, or the peer does not take the topic: the messages have to wait."""
        self.index = None
        self.queued = False

    def start_epoch(self, index: int, topic: Topic, counters: Outbound, now: float, newcomer: bool) -> None:
        """Other keys are in use: everything is sealed and sent anew, with the numbers that it had.

        Args:
            index: Of the topic in the new epoch.
            topic: Its row, as agreed.
            counters: Its counters.
            now: Time.
            newcomer: Whether the peer is another one than before.
        """
        self.index, self.topic, self.counters = index, topic, counters
        self.queued = False
        if newcomer and self._kept is not None and not self._in_flight and not self._waiting:
            self._in_flight[self._kept.sequence] = self._kept
            self._in_flight_bytes += len(self._kept.payload)
        self._again.clear()
        self._timers.clear()
        for pending in self._in_flight.values():
            pending.shards = None
            pending.attempts = 0
            pending.held = pending.queued = False
            self._queue(pending)
        self.forward_at = now if self._next and not newcomer else math.inf

    def next(self, now: float) -> PendingMessage | None:
        """What to send now; tell with `sent` when it is under way."""
        self._expire(now)
        while self._again:
            pending = self._again.popleft()
            pending.queued = False
            if pending.sequence in self._in_flight and not pending.held:
                self.counters.retransmitted += pending.shards is None
                return pending
        if not self._waiting or not self._room():
            return None
        pending = self._waiting.popleft()
        self._waiting_bytes -= len(pending.payload)
        pending.sequence = self._next
        self._next += 1
        self._in_flight[pending.sequence] = pending
        self._in_flight_bytes += len(pending.payload)
        self.counters.sent += 1
        self.counters.payload_sent += original_size(pending.payload)
        return pending

    def prefix(self, pending: PendingMessage) -> bytes:
        """What goes before the payload."""
        return PREFIX.pack(pending.sequence, pending.sequence - self.base)

    def sent(self, pending: PendingMessage, now: float) -> None:
        """All of it was sent; wait for what the peer says."""
        pending.due = now + self._rtt.timeout_after(pending.attempts)
        heapq.heappush(self._timers, (pending.due, pending.sequence))

    def landed(self, pending: PendingMessage, shards: SelectiveRepeat, now: float) -> None:
        """All shards that are known to be needed were sent."""
        if pending.shards is shards:
            self.sent(pending, now)

    def acknowledged(self, ack: Ack) -> None:
        """The peer tells what it has."""
        while self._in_flight and (sequence := self.base) < ack.expected:
            self._land(self._in_flight[sequence])
        for i, byte in enumerate(ack.held[: WINDOW // 8]):
            for bit in range(8):
                if byte >> bit & 1:
                    pending = self._in_flight.get(ack.expected + 1 + 8 * i + bit)
                    if pending is not None:
                        pending.held = True
                        pending.due = math.inf
                        if pending.shards is not None:
                            pending.shards.cancel()
        if ack.expected >= self.base:
            self.forward_at = math.inf

    def missing(self, number: int, until: int, rows: tuple[tuple[int, bytes], ...], now: float) -> None:
        """The peer tells what it lacks of a large message."""
        for pending in self._in_flight.values():
            if pending.shards is not None and pending.shards.number == number:
                pending.attempts = 0
                count = pending.shards.missing(until, rows, now, self._rtt.timeout)
                if count:
                    self.counters.retransmitted += count
                    pending.due = math.inf
                    self._queue(pending)
                return

    def resume(self, now: float) -> None:
        """The peer is heard again after a silence: do not wait for the timers."""
        for pending in self._in_flight.values():
            if pending.due < math.inf:
                pending.attempts = 0
                self._remind(pending, now)

    def handle_timer(self, now: float) -> None:
        """Send again what is due, drop what is too old."""
        self._expire(now)
        while self._timers and self._timers[0][0] <= now:
            due, sequence = heapq.heappop(self._timers)
            pending = self._in_flight.get(sequence)
            if pending is not None and pending.due == due and not pending.held:
                self._remind(pending, now)

    def forwarding(self, now: float) -> bool:
        """Whether to tell the peer the base now; it is told again until an acknowledgement shows that it is known."""
        if now < self.forward_at:
            return False
        self.forward_at = now + self._rtt.timeout_after(1)
        return self.index is not None

    def _remind(self, pending: PendingMessage, now: float) -> None:
        pending.due = math.inf
        pending.attempts += 1
        shards = pending.shards
        if shards is not None:
            if pending.attempts > RESEAL_AFTER:
                pending.shards = None
                pending.attempts = 0
            else:
                self.counters.retransmitted += shards.remind(now, self._rtt.timeout)
        self._queue(pending)

    def _queue(self, pending: PendingMessage) -> None:
        if not pending.queued:
            pending.queued = True
            self._again.append(pending)

    def _room(self) -> bool:
        in_flight = len(self._in_flight)
        if not in_flight:
            return True
        size = len(self._waiting[0].payload)
        return in_flight < min(self.topic.depth, WINDOW) and self._in_flight_bytes + size <= WINDOW_BYTES

    def _expire(self, now: float) -> None:
        while self._in_flight and (pending := self._in_flight[self.base]).deadline <= now:
            self._land(pending)
            self.counters.expired += 1
            self.forward_at = now
        while self._waiting and self._waiting[0].deadline <= now:
            self._waiting_bytes -= len(self._waiting.popleft().payload)
            self.counters.expired += 1

    def _land(self, pending: PendingMessage) -> None:
        """It is not under way any more."""
        del self._in_flight[pending.sequence]
        self._in_flight_bytes -= len(pending.payload)
        pending.due = math.inf
        if pending.shards is not None:
            pending.shards.cancel()
            pending.shards = None
