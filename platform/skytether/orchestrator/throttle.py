"""How many requests who may make: token buckets, bounded in number. Pure."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable

_BUCKETS = 4096
"""Callers that are remembered; of more, the one that was quiet for the longest begins anew."""


class Throttle:
    """A bucket for each caller: a rate that holds on average, and a burst; safe from any thread."""

    def __init__(self, rate: float, burst: int, clock: Callable[[], float]) -> None:
        """``rate`` in requests a second; ``clock`` is monotonic."""
        self._rate = rate
        self._burst = float(burst)
        self._clock = clock
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()
        self._lock = threading.Lock()

    def wait(self, caller: str) -> float:
        """Take one request from a caller's bucket; seconds until there is one if it is empty, else 0."""
        with self._lock:
            return self._take(caller, self._clock())

    def _take(self, caller: str, now: float) -> float:
        level, at = self._buckets.get(caller, (self._burst, now))
        level = min(self._burst, level + max(0.0, now - at) * self._rate)
        allowed = level >= 1.0
        self._buckets[caller] = (level - 1.0 if allowed else level, now)
        self._buckets.move_to_end(caller)
        while len(self._buckets) > _BUCKETS:
            self._buckets.popitem(last=False)
        return 0.0 if allowed else (1.0 - level) / self._rate
