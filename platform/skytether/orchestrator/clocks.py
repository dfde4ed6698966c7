"""Leases and waits are dated by the wall clock, which somebody may set: that is noticed, by one that nobody can set."""

from __future__ import annotations

_SET = 1.0
"""Seconds: a clock that is off by more since the last look was set, or its machine slept; slewing stays below."""


class SetClock:
    """Tells by how much the wall clock was set."""

    def __init__(self, wall: float, steady: float) -> None:
        """``wall``: seconds since the epoch; ``steady``: monotonic seconds of the same moment."""
        self._offset = wall - steady

    def set_by(self, wall: float, steady: float) -> float:
        """Seconds by which it was set since ``accept``, forward positive; 0: it was not."""
        by = wall - steady - self._offset
        return by if abs(by) > _SET else 0.0

    def accept(self, wall: float, steady: float) -> None:
        """From now on this is right."""
        self._offset = wall - steady
