"""A control loop that stood still: its process was stopped or starved, or the computer slept.

Wheels stop by themselves when they hear nothing (`RobotHardware`). Whoever goes on after such a gap with what it knew
before tells a standing robot to drive. CLOCK_MONOTONIC does not see a suspend, because it stands still itself;
CLOCK_BOOTTIME goes on, so the difference of the two grows by what was slept. Pure: times are arguments.
"""

from __future__ import annotations

from math import inf, isfinite

_SLEPT_S = 0.005
"""Growth of the difference of both clocks that is a suspend [s]: they are read within microseconds, and the wakening of
a computer takes longer than this."""


class StallWatch:
    """Finds gaps between the turns of a loop.

    Args:
        most_s: The longest time between two turns that is none [s].
    """

    def __init__(self, most_s: float) -> None:
        self._most_s = most_s
        self._last: float | None = None
        self._ahead = -inf

    def tick(self, now: float, boot: float | None = None) -> float:
        """A turn begins.

        Args:
            now: Seconds of the clock that stands still in a suspend.
            boot: Of the clock that goes on, read just before ``now``; None: there is none.

        Returns:
            For how long the loop stood [s]; 0: it did not.
        """
        gap = self.late(now, boot)
        if isfinite(now):
            self._last = now
        if boot is not None and isfinite(boot - now):
            # Whoever is interrupted between both clocks finds too little here, never too much.
            self._ahead = max(self._ahead, boot - now)
        return gap

    def late(self, now: float, boot: float | None = None) -> float:
        """The same without beginning a turn: how long the present one has stood, if that is too long [s]."""
        if self._last is None or not isfinite(now):
            return 0.0  # a clock that fails is the supervisor's business
        gap = now - self._last
        slept = 0.0 if boot is None or self._ahead == -inf else boot - now - self._ahead
        if slept > _SLEPT_S:
            return max(gap, 0.0) + slept
        return gap if gap > self._most_s else 0.0
