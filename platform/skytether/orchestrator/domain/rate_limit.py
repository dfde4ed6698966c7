"""How many requests who may make: token buckets, bounded in number. Safe from any thread."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable

_BUCKETS = 4096
"""Callers that are remembered; of more, the one that was quiet for the longest begins anew."""


class RateLimiter:
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
            return self._consume(caller, self._clock())

    def empty(self, caller: str) -> float:
        """Seconds until there is one request in a caller's bucket; nothing is taken."""
        with self._lock:
            level = self._level(caller, self._clock())
            return 0.0 if level >= 1.0 else (1.0 - level) / self._rate

    def charge(self, caller: str, requests: float) -> None:
        """A request was as much work as several: the next one is due so much later, at most a burst."""
        with self._lock:
            now = self._clock()
            self._keep(caller, max(-self._burst, self._level(caller, now) - requests), now)

    def _level(self, caller: str, now: float) -> float:
        level, at = self._buckets.get(caller, (self._burst, now))
        return min(self._burst, level + max(0.0, now - at) * self._rate)

    def _consume(self, caller: str, now: float) -> float:
        level = self._level(caller, now)
        allowed = level >= 1.0
        self._keep(caller, level - 1.0 if allowed else level, now)
        return 0.0 if allowed else (1.0 - level) / self._rate

    def _keep(self, caller: str, level: float, now: float) -> None:
        self._buckets[caller] = (level, now)
        self._buckets.move_to_end(caller)
        while len(self._buckets) > _BUCKETS:
            self._buckets.popitem(last=False)
