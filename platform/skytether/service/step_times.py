"""How long the steps of a service take: what the orchestrator gives it more cores for, where its manifest says so."""

from __future__ import annotations

import math
from collections import deque

SHARE = 0.95
"""Of the steps that take no longer than what is told."""
_WINDOW_S = 5.0
_FEWEST = 20
"""Steps that are looked at, however long ago they were."""
_MOST = 2000
"""Steps that are remembered: of the window, at 400 Hz."""
_CHANGED = 0.1
"""Share by which it has changed before it is told again: what is told is read from a file."""


class StepTimes:
    """Of one service. Noted by the thread that steps, asked by another one."""

    def __init__(self) -> None:
        self._steps: deque[tuple[float, float]] = deque(maxlen=_MOST)
        self._told: float | None = None

    def note(self, ended_at: float, seconds: float) -> None:
        """One more step."""
        self._steps.append((ended_at, seconds))

    def typical(self, now: float) -> float | None:
        """Of the steps of late `SHARE` took no longer [s]; None: there was none."""
        steps = list(self._steps)
        recent = [seconds for ended_at, seconds in steps if ended_at >= now - _WINDOW_S]
        if len(recent) < _FEWEST:
            recent = [seconds for _, seconds in steps[-_FEWEST:]]
        if not recent:
            return None
        return sorted(recent)[max(0, math.ceil(SHARE * len(recent)) - 1)]

    def news(self, now: float) -> float | None:
        """The same, if it is worth telling; None: it is much as it was told last."""
        typical = self.typical(now)
        if typical is None or (self._told is not None and abs(typical - self._told) <= _CHANGED * self._told):
            return None
        self._told = typical
        return typical
