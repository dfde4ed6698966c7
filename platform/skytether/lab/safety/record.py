"""What the wheels received, and when."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque

from skytether.guard.clock import now
from skytether.guard.velocity import STANDSTILL

from .checker import SentVelocity

_LONGEST = 200_000
"""Velocities that are kept: an hour at 50 Hz. Of a flood the oldest go."""


class WheelRecord:
    """Remembers; from any thread."""

    def __init__(self) -> None:
        self._told: deque[SentVelocity] = deque([SentVelocity(now(), STANDSTILL)], _LONGEST)

    @property
    def last(self) -> SentVelocity:
        """What they were told last; they begin with a standstill."""
        return self._told[-1]

    def add(self, told: SentVelocity) -> None:
        """Remember one more."""
        self._told.append(told)

    def since(self, start: float) -> list[SentVelocity]:
        """Everything from a moment on, in order of time, and the last before it."""
        told = sorted(self._told.copy(), key=lambda told: told.at)
        first = bisect_left(told, start, key=lambda told: told.at)
        return told[max(0, first - 1) :]
