"""Gaps in the sequence numbers of a topic: what is late, and what is lost."""

from __future__ import annotations

from collections import deque


class _Gap:
    __slots__ = ("deadline", "end", "filled", "first")

    def __init__(self, first: int, end: int, deadline: float) -> None:
        self.first = first
        self.end = end
        self.deadline = deadline
        self.filled = 0


class SequenceTracker:
    """Which sequence numbers of a topic are missing, and since when.

    A gap counts as lost once it is older than the topic's lifespan. Every number is observed at most once (the
    replay window sees to that), so a number below the next expected one fills a gap.
    """

    MAX_GAPS = 1024
    """Gaps that may be open; the oldest is settled early beyond that."""

    __slots__ = ("_gaps", "_lifespan", "lost", "next", "received")

    def __init__(self, lifespan: float) -> None:
        self._lifespan = lifespan
        self._gaps: deque[_Gap] = deque()
        self.next = 0
        """Lowest number above all that the sender is known to have used."""
        self.received = 0
        self.lost = 0
        """Numbers that went missing, without those that came late after all."""

    def observe(self, sequence: int, now: float) -> bool:
        """Take an arrival.

        Returns:
            True if the number had been counted lost.
        """
        self.received += 1
        if sequence == self.next:
            self.next += 1
            return False
        if sequence > self.next:
            self._open(sequence, now)
            self.next = sequence + 1
            return False
        for gap in self._gaps:
            if gap.first <= sequence < gap.end:
                gap.filled += 1
                return False
        self.lost -= 1
        return True

    def sent(self, count: int, now: float) -> None:
        """The sender says that it has used all numbers below ``count``."""
        if count > self.next:
            self._open(count, now)
            self.next = count

    def settle(self, now: float) -> None:
        """Count what is missing for too long."""
        gaps = self._gaps
        while gaps and gaps[0].deadline <= now:
            self._lose(gaps.popleft())

    def _open(self, end: int, now: float) -> None:
        self._gaps.append(_Gap(self.next, end, now + self._lifespan))
        if len(self._gaps) > self.MAX_GAPS:
            self._lose(self._gaps.popleft())

    def _lose(self, gap: _Gap) -> None:
        self.lost += gap.end - gap.first - gap.filled
