"""Reliable topics (rule 7), an object for each end of each: every message once and in order, delivered or expired.

Messages of a reliable topic are sealed and sent as all others are, at the topic's own priority, and start with a
prefix: their sequence number, and how many numbers below it the sender has not given up. A message is sent again when
it is not acknowledged in time: a small one sealed anew, a large one shard by shard (`parcel`). Both objects outlive
handshakes. The sender's numbers go on for as long as its end lives, so a peer that lives on takes nothing twice; a peer
that was restarted begins with the lowest number that the sender has not given up.
"""

from __future__ import annotations

import heapq
import math
from collections import deque

from ..codec.compression import original_size
from ..codec.frames import Ack
from ..codec.plaintext import PREFIX
from ..fec.reassembly import Entry
from ..measure.counters import Outbound
from ..measure.rtt import ACK_DELAY, RttEstimator
from ..topic import Topic
from .parcel import Parcel

WINDOW = 1024
"""Messages of a topic that may be under way; an acknowledgement has a bit for each."""
WINDOW_BYTES = 2**20
"""Bytes of a topic that may be under way, except for a single message: bounds what the receiver has to hold."""
HELD_LIMIT = 2 * WINDOW_BYTES
"""Bytes of a topic that the receiver holds back until what goes before them arrives."""
NUMBERS = 2**63
"""Above all numbers that anybody will ever use."""
FAR_AHEAD = 2**32
"""Most messages that a sender may have given up at a time."""
STATUS_DELAY = 0.025
"""Seconds between accounts of what is missing in a large message that is arriving."""
RESEAL_AFTER = 6
"""Reminders without an answer after which a large message is sent anew from the start: the peer may have taken its
number for an old one."""
NUMBER_SPAN = 32_768
"""Messages sealed since, after which a large message is sent anew: half of the peer's replay window."""


class Letter:
    """One message until it is acknowledged or expired."""

    __slots__ = ("attempts", "deadline", "due", "held", "parcel", "payload", "published_at", "queued", "sequence")

    def __init__(self, payload: bytes, published_at: float, deadline: float) -> None:
        self.payload = payload
        self.published_at = published_at
        self.deadline = deadline
        self.sequence = -1
        """Given when it is first sent."""
        self.parcel: Parcel | None = None
        """A large message's shards, sealed under the keys in use."""
        self.attempts = 0
        """In vain, since the peer was last heard of it."""
        self.due = math.inf
        """When to send it again."""
        self.held = False
        """The peer has it, but waits for one before it."""
        self.queued = False
        """It is to be sent."""


class Outbox:
    """The sending end of a reliable topic.

    Args:
        topic: Its row.
        counters: Its counters.
        rtt: Of the session.
    """

    __slots__ = (
        "_again", "_flying", "_flying_bytes", "_kept", "_next", "_rtt", "_timers", "_waiting", "_waiting_bytes",
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
        self._waiting: deque[Letter] = deque()
        """Never sent."""
        self._waiting_bytes = 0
        self._flying: dict[int, Letter] = {}
        """Sent and not acknowledged, by rising number."""
        self._flying_bytes = 0
        self._again: deque[Letter] = deque()
        """To be sent again."""
        self._timers: list[tuple[float, int]] = []
        """Heap of due times and numbers; those that changed since are skipped."""
        self._kept: Letter | None = None
        """The newest message of a latched topic."""

    @property
    def base(self) -> int:
        """Lowest number that is not given up or acknowledged."""
        return next(iter(self._flying), self._next)

    @property
    def ready(self) -> bool:
        """Whether `next` has something."""
        return self.index is not None and bool(self._again or (self._waiting and self._room()))

    @property
    def used(self) -> int:
        """Payload bytes kept."""
        kept = self._kept
        landed = kept is not None and kept.sequence >= 0 and kept.sequence not in self._flying
        return self._flying_bytes + self._waiting_bytes + (len(kept.payload) if kept is not None and landed else 0)

    @property
    def idle(self) -> bool:
        """Whether there is nothing to wait for."""
        return not self._flying and not self._waiting and self.forward_at == math.inf

    @property
    def due(self) -> float:
        """When to call `handle_timer`."""
        due = self._timers[0][0] if self._timers else math.inf
        for letter in (next(iter(self._flying.values()), None), self._waiting[0] if self._waiting else None):
            if letter is not None and letter.deadline < due:
                due = letter.deadline
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
        full = topic.depth > 1 and len(self._flying) + len(self._waiting) >= topic.depth
        if full or len(payload) > room:
            self.counters.replaced += 1
            return False
        if topic.depth == 1 and self._waiting:
            self._waiting_bytes -= len(self._waiting.pop().payload)
            self.counters.replaced += 1
        letter = Letter(payload, now, math.inf if topic.latched else now + topic.lifespan)
        if topic.latched:
            if self._kept is not None:  # as mortal as others from now on
                self._kept.deadline = min(self._kept.deadline, self._kept.published_at + topic.lifespan)
            self._kept = letter
        self._waiting.append(letter)
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
        if newcomer and self._kept is not None and not self._flying and not self._waiting:
            self._flying[self._kept.sequence] = self._kept
            self._flying_bytes += len(self._kept.payload)
        self._again.clear()
        self._timers.clear()
        for letter in self._flying.values():
            letter.parcel = None
            letter.attempts = 0
            letter.held = letter.queued = False
            self._queue(letter)
        self.forward_at = now if self._next and not newcomer else math.inf

    def next(self, now: float) -> Letter | None:
        """What to send now; tell with `sent` when it is under way."""
        self._expire(now)
        while self._again:
            letter = self._again.popleft()
            letter.queued = False
            if letter.sequence in self._flying and not letter.held:
                self.counters.retransmitted += letter.parcel is None
                return letter
        if not self._waiting or not self._room():
            return None
        letter = self._waiting.popleft()
        self._waiting_bytes -= len(letter.payload)
        letter.sequence = self._next
        self._next += 1
        self._flying[letter.sequence] = letter
        self._flying_bytes += len(letter.payload)
        self.counters.sent += 1
        self.counters.payload_sent += original_size(letter.payload)
        return letter

    def prefix(self, letter: Letter) -> bytes:
        """What goes before the payload."""
        return PREFIX.pack(letter.sequence, letter.sequence - self.base)

    def sent(self, letter: Letter, now: float) -> None:
        """All of it was sent; wait for what the peer says."""
        letter.due = now + self._rtt.timeout_after(letter.attempts)
        heapq.heappush(self._timers, (letter.due, letter.sequence))

    def landed(self, letter: Letter, parcel: Parcel, now: float) -> None:
        """All shards that are known to be needed were sent."""
        if letter.parcel is parcel:
            self.sent(letter, now)

    def acknowledged(self, ack: Ack) -> None:
        """The peer tells what it has."""
        while self._flying and (sequence := self.base) < ack.expected:
            self._land(self._flying[sequence])
        for i, byte in enumerate(ack.held[: WINDOW // 8]):
            for bit in range(8):
                if byte >> bit & 1:
                    letter = self._flying.get(ack.expected + 1 + 8 * i + bit)
                    if letter is not None:
                        letter.held = True
                        letter.due = math.inf
                        if letter.parcel is not None:
                            letter.parcel.cancel()
        if ack.expected >= self.base:
            self.forward_at = math.inf

    def missing(self, number: int, until: int, rows: tuple[tuple[int, bytes], ...], now: float) -> None:
        """The peer tells what it lacks of a large message."""
        for letter in self._flying.values():
            if letter.parcel is not None and letter.parcel.number == number:
                letter.attempts = 0
                count = letter.parcel.missing(until, rows, now, self._rtt.timeout)
                if count:
                    self.counters.retransmitted += count
                    letter.due = math.inf
                    self._queue(letter)
                return

    def resume(self, now: float) -> None:
        """The peer is heard again after a silence: do not wait for the timers."""
        for letter in self._flying.values():
            if letter.due < math.inf:
                letter.attempts = 0
                self._remind(letter, now)

    def handle_timer(self, now: float) -> None:
        """Send again what is due, drop what is too old."""
        self._expire(now)
        while self._timers and self._timers[0][0] <= now:
            due, sequence = heapq.heappop(self._timers)
            letter = self._flying.get(sequence)
            if letter is not None and letter.due == due and not letter.held:
                self._remind(letter, now)

    def forwarding(self, now: float) -> bool:
        """Whether to tell the peer the base now; it is told again until an acknowledgement shows that it is known."""
        if now < self.forward_at:
            return False
        self.forward_at = now + self._rtt.timeout_after(1)
        return self.index is not None

    def _remind(self, letter: Letter, now: float) -> None:
        letter.due = math.inf
        letter.attempts += 1
        parcel = letter.parcel
        if parcel is not None:
            if letter.attempts > RESEAL_AFTER:
                letter.parcel = None
                letter.attempts = 0
            else:
                self.counters.retransmitted += parcel.remind(now, self._rtt.timeout)
        self._queue(letter)

    def _queue(self, letter: Letter) -> None:
        if not letter.queued:
            letter.queued = True
            self._again.append(letter)

    def _room(self) -> bool:
        flying = len(self._flying)
        if not flying:
            return True
        size = len(self._waiting[0].payload)
        return flying < min(self.topic.depth, WINDOW) and self._flying_bytes + size <= WINDOW_BYTES

    def _expire(self, now: float) -> None:
        while self._flying and (letter := self._flying[self.base]).deadline <= now:
            self._land(letter)
            self.counters.expired += 1
            self.forward_at = now
        while self._waiting and self._waiting[0].deadline <= now:
            self._waiting_bytes -= len(self._waiting.popleft().payload)
            self.counters.expired += 1

    def _land(self, letter: Letter) -> None:
        """It is not under way any more."""
        del self._flying[letter.sequence]
        self._flying_bytes -= len(letter.payload)
        letter.due = math.inf
        if letter.parcel is not None:
            letter.parcel.cancel()
            letter.parcel = None


Delivery = tuple[int, int, bytes]
"""Sequence number, time of publishing as it came (`plaintext.INNER`), payload."""


class Inbox:
    """The receiving end of a reliable topic, of one peer.

    Args:
        owing: It adds itself to these when it has something to acknowledge.
    """

    __slots__ = ("_expected", "_held", "_held_bytes", "_owing", "due", "entries", "index", "skipped")

    def __init__(self, owing: set[Inbox]) -> None:
        self._owing = owing
        self.index = 0
        """Of the topic, in the epoch in use."""
        self.due = math.inf
        """When to acknowledge."""
        self.entries: dict[tuple[bytes, int], Entry] = {}
        """Large messages of which something arrived since the last account."""
        self.skipped = 0
        """Messages that the sender gave up and that never arrived."""
        self._expected: int | None = None
        """None before the first message."""
        self._held: dict[int, tuple[int, bytes]] = {}
        self._held_bytes = 0

    def start_epoch(self, index: int, now: float) -> None:
        """Other keys are in use: tell the peer at once what need not be sent again."""
        self.index = index
        self.entries.clear()
        self.due = math.inf
        if self._expected is not None:
            self.due = now
            self._owing.add(self)

    def touch(self, now: float, entry: Entry | None = None) -> None:
        """Something arrived: part of a large message, or one that was complete already."""
        if entry is None:
            self.due = min(self.due, now + ACK_DELAY)
        else:
            self.entries[entry.key] = entry
            self.due = min(self.due, now + STATUS_DELAY)
        self._owing.add(self)

    def take(self, body: bytes, micros: int, now: float) -> list[Delivery]:
        """An authentic message arrived; returns what can be delivered now."""
        if len(body) < PREFIX.size:
            return []
        sequence, below = PREFIX.unpack_from(body)
        base = max(sequence - below, 0)
        if base > NUMBERS - FAR_AHEAD:
            return []
        self.touch(now)
        if self._expected is None:
            self._expected = base
        payload = body[PREFIX.size :]
        # The one that everything waits for is taken whatever its size.
        fits = sequence == self._expected or self._held_bytes + len(payload) <= HELD_LIMIT
        if fits and self._expected <= sequence <= self._expected + WINDOW and sequence not in self._held:
            self._held[sequence] = micros, payload
            self._held_bytes += len(payload)
        return self.forward(base)

    def forward(self, base: int) -> list[Delivery]:
        """The sender gave up all below ``base``; returns what can be delivered now."""
        expected = base if self._expected is None else self._expected
        if base > expected + FAR_AHEAD or base > NUMBERS - FAR_AHEAD:  # nobody has sent that many
            return []
        out: list[Delivery] = []
        if base > expected:
            out.extend(self._release(s) for s in sorted(self._held) if s < base)
            self.skipped += base - expected - len(out)
            expected = base
        while expected in self._held:
            out.append(self._release(expected))
            expected += 1
        self._expected = expected
        return out

    def acknowledgement(self) -> Ack | None:
        """What to tell the sender; None before the first message."""
        expected = self._expected
        if expected is None:
            return None
        bits = sum(1 << (sequence - expected - 1) for sequence in self._held)
        return Ack(self.index, expected, bits.to_bytes((bits.bit_length() + 7) // 8, "little"))

    def _release(self, sequence: int) -> Delivery:
        micros, payload = self._held.pop(sequence)
        self._held_bytes -= len(payload)
        return sequence, micros, payload
