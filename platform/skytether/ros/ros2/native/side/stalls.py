"""Velocities that waited while this process stood still: late, they are worse than none. Pure."""

from __future__ import annotations

from collections.abc import Hashable
from math import inf

STOOD_S = 0.3
"""Without a turn: this process stood still, and what waited for it is old."""
TURN_S = 0.05
DRAINED_S = 0.2
"""For what waited meanwhile to come; no velocity is taken until then."""
DRIFT = 1e-4
"""Two clocks go apart by less [s/s]; more slowly than that the quickest is forgotten."""
SENT_AGAIN_S = 4.0
"""After that a reliable publisher has sent again what this process missed: DDS asks each 3 s what somebody has."""


class Stalls:
    """Knows when this process stood still, and so which velocities are old.

    Whoever publishes may have another clock, and of several each its own: after a stall, a velocity is old if it took
    longer than the quickest of the topic did; if none came before, its publisher's clock is taken to be ours.

    Args:
        now: Seconds, of a clock that goes on while the machine sleeps; as ``now`` of the methods.
    """

    def __init__(self, now: float) -> None:
        self._turned = now
        self._went_on = -inf
        self._quickest: dict[Hashable, tuple[float, float]] = {}
        """By topic: how long the quickest velocity took, by its publisher's clock and ours, and when that came [s]."""
        self._came: dict[Hashable, tuple[float, float]] = {}
        """When the last two messages came [s]."""

    def turn(self, now: float) -> None:
        """This process has a turn, as it should each `TURN_S`; from one thread."""
        self._is_over(now)
        self._turned = now

    def note(self, topic: Hashable, now: float) -> None:
        """A message came."""
        self._came[topic] = self._came.get(topic, (-inf, -inf))[1], now

    def is_old(self, topic: Hashable, took: float | None, now: float) -> bool:
        """Whether a velocity is not to be taken.

        Args:
            topic: Where it came.
            took: How long it took, by its publisher's clock and ours [s]; None: it is not told when it was published.
            now: When it came.
        """
        if not self._is_over(now):
            return True
        if took is None:
            return False
        quickest, at = self._quickest.get(topic, (0.0, now))
        usual = quickest + DRIFT * (now - at)
        if now - self._went_on < SENT_AGAIN_S and took - usual > STOOD_S:
            return True
        self._quickest[topic] = (min(took, usual) if topic in self._quickest else took), now
        return False

    def explains(self, topic: Hashable) -> bool:
        """Whether messages that DDS says are lost came while this process stood still.

        DDS says it with the first message after those, be that long after this process went on.
        """
        return self._went_on > self._came.get(topic, (-inf, -inf))[0]

    def _is_over(self, now: float) -> bool:
        """Whether the last stall is; this may be the first to see one."""
        if now - self._turned > STOOD_S:
            self._went_on = now
        return now - self._went_on >= DRAINED_S
