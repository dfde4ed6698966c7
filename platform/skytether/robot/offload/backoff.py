"""Waiting longer after each failure, never all robots at once."""

from __future__ import annotations

from random import Random


class Backoff:
    """Doubling delays with jitter: each is drawn from the upper half of its range.

    Args:
        first: Longest first delay [s].
        most: Longest delay ever [s].
        random: Source of the jitter.
    """

    def __init__(self, first: float, most: float, random: Random) -> None:
        self._first = first
        self._most = most
        self._random = random
        self._next = first

    def next(self) -> float:
        """The delay after one more failure [s]."""
        delay = self._next * self._random.uniform(0.5, 1.0)
        self._next = min(self._next * 2, self._most)
        return delay

    def reset(self) -> None:
        """It worked: the next failure starts from the beginning."""
        self._next = self._first
