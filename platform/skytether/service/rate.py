"""What a service does less often than it steps, or only once something has lasted."""

from __future__ import annotations

import math


class Rate:
    """Says when something that is done so often is due; what is late is not made up for."""

    def __init__(self, hertz: float) -> None:
        self._period = 1 / hertz if hertz > 0 else math.inf
        self._next = -math.inf

    def due(self, now: float) -> bool:
        """Whether to do it now [s]; then the next time is a period later."""
        # A little early is better than a whole step of the loop late.
        if now < self._next - 1e-4 or math.isinf(self._period):
            return False
        self._next = max(self._next + self._period, now) if math.isfinite(self._next) else now + self._period
        return True


class Lasting:
    """Says once of each new state when it has lasted: what is over at once is nobody's to know."""

    def __init__(self, first: object = None) -> None:
        """``first``: the state in the beginning, of which nothing is said."""
        self._state, self._since = first, math.inf

    def due(self, state: object, now: float, lasts: float) -> bool:
        """Whether to say it now [s]: it is the same for ``lasts`` seconds, and it was not said yet."""
        if state != self._state:
            self._state, self._since = state, now
        if now - self._since < lasts:
            return False
        self._since = math.inf
        return True
