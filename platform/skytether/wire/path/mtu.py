"""The largest datagram that passes a path, found by padded questions (RFC 8899, datagram PLPMTUD).

A probe alone cannot tell a small path from a lossy one. So each round asks with a small packet and with large ones
together, and counts only if the small one was answered: as many such rounds without the large one are needed as
make it improbable that loss alone did it.
"""

from __future__ import annotations

import math

LADDER = (512, 600, 800, 1000, 1200, 1300, 1400, 1452, 8952)
"""Sizes tried: what tunnels, mobile networks, Ethernet and jumbo frames leave for UDP's payload."""
SMALL = 0
"""The size of a question that is not padded."""
CERTAIN = 1e-4
"""Probability with which loss alone may look like a smaller path."""
MIN_ROUNDS = 3
MAX_ROUNDS = 30
CONFIRM_INTERVAL = 1.0
"""Seconds between rounds while large packets are sent: how long a path that got smaller goes unnoticed."""
RAISE_INTERVAL = 60.0
"""Seconds until a larger size that did not pass is tried again."""


class MtuSearch:
    """Decides what sizes to ask with, and learns from the answers.

    Attributes:
        size: Largest datagram to send now.
        due: When `probe` should be called; inf while nothing is to be found out.
    """

    __slots__ = (
        "_answered", "_answered_small", "_asked", "_asked_small", "_limit", "_missed", "_passed", "_raise_at",
        "_rounds", "_start", "_top", "due", "size",
    )  # fmt: skip

    def __init__(self, start: int, top: int) -> None:
        """Begin without asking anything.

        Args:
            start: Size that is taken to pass until probes say otherwise.
            top: Largest size to try.
        """
        self._start = start
        self._limit = max(start, top)
        self._asked_small = self._answered_small = 0
        self.due = math.inf
        self._reset()

    def _reset(self) -> None:
        self.size = self._start
        self._top = self._limit
        self._asked: tuple[int, ...] = ()
        """Sizes of the round under way."""
        self._answered: set[int] = set()
        self._missed = 0
        """Rounds in which the present size did not pass, and a small packet did."""
        self._passed = 0
        """Largest size that passed since the present one was first missed."""
        self._rounds = 0
        """Rounds in which no larger size passed, and the present one did."""
        self._raise_at = 0.0

    def restart(self, now: float) -> None:
        """The path is new, or leads elsewhere: find out at once."""
        self._reset()
        self.due = now

    def stop(self) -> None:
        """Nothing can be asked for now."""
        self.due = math.inf
        self._asked = ()

    def probe(self, now: float, patience: float, busy: bool) -> tuple[int, ...]:
        """Judge the round before, begin the next.

        Args:
            now: Time.
            patience: Seconds that an answer may take.
            busy: Whether large packets were sent lately, so that it matters.

        Returns:
            Sizes to ask with; empty if there is nothing to find out now.
        """
        self._judge(now)
        searching = bool(self._missed) or now >= self._raise_at
        if not searching and not busy:
            self._asked = ()
            self.due = now + CONFIRM_INTERVAL
            return ()
        if self._missed:
            sizes = [s for s in LADDER if s < self.size]
        else:
            sizes = [s for s in {*LADDER, self._top} if self.size < s <= self._top] if now >= self._raise_at else []
        self._asked = (SMALL, *sorted(sizes), self.size)
        self._answered.clear()
        self.due = now + (patience if searching else CONFIRM_INTERVAL)
        return self._asked

    def answer(self, size: int) -> None:
        """The peer got a question of that size."""
        if size not in self._asked:
            return
        self._answered.add(size)
        if size > self.size:
            self.size = size
            self._rounds = 0
        if size == self.size:
            self._missed = self._passed = 0
        elif self._missed:
            self._passed = max(self._passed, size)

    def refuse(self, size: int, now: float) -> None:
        """The system says that a packet of this size is too large for the path."""
        if size > self.size:  # it was a probe
            self._top = min(self._top, self._below(size))
            return
        self.size = self._below(size)
        self._missed = self._passed = 0
        self._raise_at = now + RAISE_INTERVAL
        self.due = now

    def _judge(self, now: float) -> None:
        """What the round that ends tells."""
        asked, self._asked = self._asked, ()
        if not asked:
            return
        self._asked_small += 1
        if SMALL not in self._answered:
            return  # says nothing about sizes
        self._answered_small += 1
        if self.size not in self._answered:
            self._missed += 1
            if self._missed >= self._needed():
                self.size = self._passed or LADDER[0]
                self._missed = self._passed = 0
                self._raise_at = now + RAISE_INTERVAL
        elif now >= self._raise_at:
            self._rounds += 1
            if self.size >= self._top or self._rounds >= self._needed():
                self._rounds = 0
                self._raise_at = now + RAISE_INTERVAL

    def _needed(self) -> int:
        """Rounds that make chance improbable, from the share of small questions that stay without an answer."""
        lost = 1 - self._answered_small / (self._asked_small + 1)
        return min(max(math.ceil(math.log(CERTAIN) / math.log(lost)), MIN_ROUNDS), MAX_ROUNDS)

    @staticmethod
    def _below(size: int) -> int:
        return max((s for s in LADDER if s < size), default=LADDER[0])
