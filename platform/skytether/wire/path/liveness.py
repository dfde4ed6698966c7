"""Whether what this end sends on a path arrives: questions, each answered at once by the peer (rule 8).

Any message from the peer shows that the way here is open; only an answer shows that the way there is.
"""

from __future__ import annotations

import math
from collections import deque
from enum import IntEnum

PATIENCE_MIN = 0.02
"""Seconds an answer may take at least: a peer's busy thread is no broken path."""
PATIENCE_MAX = 0.5
PATIENCE_FIRST = 0.15
"""Seconds an answer may take before any round trip is known."""
HURRY = 0.5
"""Time between questions to a path under suspicion, in units of patience."""
DEAD_AFTER = 3.0
"""Units of patience without any answer after which a path is given up."""
MAX_OPEN = 64
"""Questions remembered."""


class Health(IntEnum):
    """What a path is good for, best first."""

    LIVE = 0
    """The latest questions were answered, or may still be."""
    SUSPECT = 1
    """An answer is overdue."""
    NEW = 2
    """No answer yet."""
    DEAD = 3


class Liveness:
    """Questions and answers of one path. Times are this end's clock."""

    __slots__ = ("_answered", "_dead", "_open", "confirmed_at", "live_since", "srtt", "variation")

    def __init__(self) -> None:
        self._open: deque[float] = deque(maxlen=MAX_OPEN)
        """When the questions without an answer were asked, since the latest answer."""
        self._answered = False
        self._dead = False
        self.srtt = math.nan
        """Smoothed round trip, and its mean deviation (RFC 6298)."""
        self.variation = 0.0
        self.confirmed_at = -math.inf
        """When the latest question with an answer was asked: what was sent before has arrived, as far as is known."""
        self.live_since = math.inf
        """When it last became usable; suspicion that came to nothing does not count."""

    @property
    def patience(self) -> float:
        """Seconds an answer may take before the path is suspected."""
        if not self._answered:
            return PATIENCE_FIRST
        return min(max(1.25 * self.srtt + 4 * self.variation, self.srtt + PATIENCE_MIN), self.srtt + PATIENCE_MAX)

    @property
    def age(self) -> float:
        """When the oldest open question was asked; inf if there is none."""
        return self._open[0] if self._open else math.inf

    def ask(self, now: float) -> None:
        """A question was sent."""
        if len(self._open) < MAX_OPEN:
            self._open.append(now)

    def answer(self, asked_at: float, rtt: float, now: float) -> None:
        """Take the answer to the question of that time."""
        while self._open and self._open[0] <= asked_at + 2e-6:  # the time travels in microseconds
            self._open.popleft()
        self.confirmed_at = max(self.confirmed_at, asked_at)
        if self._answered:
            self.variation += (abs(rtt - self.srtt) - self.variation) / 4
            self.srtt += (rtt - self.srtt) / 8
        else:
            self.srtt, self.variation = rtt, rtt / 2
        if self._dead or not self._answered:
            self.live_since = now
        self._answered, self._dead = True, False

    def calm(self) -> None:
        """Nobody asks any more, so no answer is missing."""
        self._open.clear()
        self._dead = False

    def health(self, now: float) -> Health:
        """What the path is good for."""
        patience = self.patience  # the sums are those of `next_change`, so that a timer never comes just too early
        if self._dead or now >= self.age + DEAD_AFTER * patience:
            self._dead = True
            return Health.DEAD
        if not self._answered:
            return Health.NEW
        return Health.SUSPECT if now >= self.age + patience else Health.LIVE

    def next_change(self, now: float) -> float:
        """When the health gets worse if no answer comes; inf if it does not."""
        if self._dead:
            return math.inf
        suspect_at = self.age + self.patience
        return suspect_at if suspect_at > now else self.age + DEAD_AFTER * self.patience
