"""A large message of a reliable topic on its way: its shards are sent until the peer has them all.

It carries no parity: what is lost is sent again as the peer tells which shards it lacks. That costs a round trip and
nothing else, which suits what is large and must arrive.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from ..codec.tags import Tagger
from ..fec.fragment import Positions, Shape, Shards


class SelectiveRepeat(Shards):
    """One sealed message."""

    __slots__ = ("_known", "_landed", "_missing", "_reported", "_sent_at", "_taken", "_todo", "number", "sending")

    def __init__(
        self,
        number: int,
        common: bytes,
        sealed: memoryview,
        shape: Shape,
        tagger: Tagger,
        landed: Callable[[SelectiveRepeat, float], None],
    ) -> None:
        """Take a sealed message; all of it is to be sent.

        Args:
            number: Message number.
            common: The header's common part.
            sealed: ``shape.shards * shape.size`` bytes, zeros after ``shape.length``.
            shape: Its layout, with more than one shard.
            tagger: Of the keys that the common part names.
            landed: Called when nothing is left to be sent for now.
        """
        super().__init__(common, sealed, shape, 0, tagger)
        self.number = number
        self._landed = landed
        self._missing = np.ones(shape.shards, bool)
        """What the peer is not known to have."""
        self._known = 0
        """Shards of which the peer has told anything."""
        self._sent_at = np.full(shape.shards, math.inf)
        """inf while a shard is to be sent."""
        self._todo: Positions = np.arange(shape.shards)
        self._taken = 0
        self.sending = False
        """Whether somebody is taking packets."""
        self._reported = False
        """Whether the peer told what is missing since the last `remind`."""

    def make_packets(self, count: int, path: int, first_number: int, time: int) -> memoryview:
        chosen = self._todo[self._taken : self._taken + count]
        self._taken += count
        self.remaining -= count
        return self.pick(chosen, path, first_number, time)

    def sent(self, count: int, now: float) -> None:
        self._sent_at[self._todo[self._taken - count : self._taken]] = now

    def land(self, now: float) -> None:
        self.sending = False
        self._landed(self, now)

    def missing(self, until: int, rows: tuple[tuple[int, bytes], ...], now: float, timeout: float) -> int:
        """The peer tells what it lacks (see `frames.Missing`).

        Returns:
            How many shards are to be sent again: those that were sent longer ago than ``timeout``.
        """
        shape = self._shape
        self._reported = True
        self._known = known = shape.block_start(min(until, shape.blocks))
        self._missing[:known] = False
        for block, bits in rows:
            if block < shape.blocks:
                start, k = shape.block_start(block), shape.block_k(block)
                lacking = np.unpackbits(np.frombuffer(bits, np.uint8), bitorder="little")[:k]
                self._missing[start : start + len(lacking)] |= lacking.astype(bool)
        return self._again(self._lost(now - timeout))

    def remind(self, now: float, timeout: float) -> int:
        """Nothing was heard for some time.

        Returns:
            How many shards are to be sent again: what the peer was lacking when it last told, or if it told nothing
            since the last time, one, so that it does.
        """
        told, self._reported = self._reported, False
        lost = self._lost(now - timeout / 2)
        if told and len(lost):
            return self._again(lost)
        last = np.flatnonzero(self._missing)[-1:]
        return self._again(last if len(last) else np.array([self._shape.shards - 1]))

    def cancel(self) -> None:
        """Send nothing more."""
        self.remaining = 0

    def _lost(self, before: float) -> Positions:
        """What the peer lacks although it was sent earlier than ``before``."""
        known = self._known
        return np.flatnonzero(self._missing[:known] & (self._sent_at[:known] < before))

    def _again(self, positions: Positions) -> int:
        if len(positions):
            self._sent_at[positions] = math.inf  # so that it is not asked for again before it was sent
            self._todo = np.concatenate([self._todo[self._taken :], positions])
            self._taken = 0
            self.remaining = len(self._todo)
        return len(positions)
