"""Velocities that waited while this process stood still: late, they are worse than none. Pure."""

from __future__ import annotations

from math import inf

STOOD_S = 0.3
"""Without a turn: this process stood still, and what waited for it is old."""
TURN_S = 0.05
DRAINED_S = 0.2
"""For what waited meanwhile to come; no velocity is taken until then."""
SENT_AGAIN_S = 4.0
"""After that a reliable publisher has sent again what this process missed: DDS asks each 3 s what somebody has."""


class Stalls:
    """Knows when this process stood still, and so which velocities are old.

    Whoever publishes may have another clock: after a stall, a velocity is old if it took longer than those before.

    Args:
        now: Seconds, of a clock that goes on while the machine sleeps; as ``now`` of the methods.
    """

    def __init__(self, now: float) -> None:
        self._turned = now
        self._went_on = -inf
        self._took: dict[int, float] = {}
        """By channel: how long the last velocity took that was not old, by its publisher's clock and ours [s]."""
        self._came: dict[int, tuple[float, float]] = {}
        """When the last two velocities came [s]."""

    def turn(self, now: float) -> None:
        """This process has a turn, as it should each `TURN_S`; from one thread."""
        self._is_over(now)
        self._turned = now

    def is_old(self, channel: int, took: float | None, now: float) -> bool:
        """Whether a velocity is not to be taken.

        Args:
            channel: Where it came.
            took: How long it took, by its publisher's clock and ours [s]; None: it is not told when it was published.
            now: When it came.
        """
        _, last = self._came.get(channel, (-inf, -inf))
        self._came[channel] = last, now
        if not self._is_over(now):
            return True
        if took is None:
            return False
        if now - self._went_on < SENT_AGAIN_S and took - self._took.get(channel, took) > STOOD_S:
            return True
        self._took[channel] = took
        return False

    def explains(self, channel: int) -> bool:
        """Whether messages that DDS says are lost came while this process stood still.

        DDS says it with the first message after those, be that long after this process went on.
        """
        before, _ = self._came.get(channel, (inf, inf))
        return self._went_on > before

    def _is_over(self, now: float) -> bool:
        """Whether the last stall is; this may be the first to see one."""
        if now - self._turned > STOOD_S:
            self._went_on = now
        return now - self._went_on >= DRAINED_S
