"""What a service does less often than it steps."""

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
