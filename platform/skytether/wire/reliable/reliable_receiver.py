"""The receiving end of a reliable topic (rule 7): every message once and in order, and what the sender is told.

What a message starts with, and when it is sent again, is in `reliable_sender`.
"""

from __future__ import annotations

import math

from ..codec.frames import Ack
from ..codec.plaintext import PREFIX
from ..fec.reassembly import Entry
from ..measure.rtt import ACK_DELAY

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


Released = tuple[int, int, bytes]
"""Sequence number, time of publishing as it came (`plaintext.INNER`), payload."""


class ReliableReceiver:
    """The receiving end of a reliable topic, of one peer.

    Args:
        owing: It adds itself to these when it has something to acknowledge.
    """

    __slots__ = ("_expected", "_held", "_held_bytes", "_owing", "due", "entries", "index", "skipped")

    def __init__(self, owing: set[ReliableReceiver]) -> None:
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

    def receive_message(self, body: bytes, micros: int, now: float) -> list[Released]:
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

    def forward(self, base: int) -> list[Released]:
        """The sender gave up all below ``base``; returns what can be delivered now."""
        expected = base if self._expected is None else self._expected
        if base > expected + FAR_AHEAD or base > NUMBERS - FAR_AHEAD:  # nobody has sent that many
            return []
        out: list[Released] = []
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

    def _release(self, sequence: int) -> Released:
        micros, payload = self._held.pop(sequence)
        self._held_bytes -= len(payload)
        return sequence, micros, payload
