"""A path's budget in bits per second (rule 6): a token bucket with a fixed rate.

Congestion control will set ``rate`` later; nothing else has to change then.
"""

from __future__ import annotations

BUCKET_TIME = 0.003
"""Seconds of sending that may be saved up: covers late timers, and bounds the queue a burst makes on the link."""
QUANTUM_TIME = 0.0005
"""Seconds of sending worth waking up for in the midst of a large message."""

ROUNDING = 1e-6
"""Seconds added to a time of waiting, so that rounding never makes it end too early to send anything."""


class Pacer:
    """Sending is allowed while tokens are positive; the last packet may overdraw them by its size."""

    __slots__ = ("_mtu", "_tokens", "_updated", "capacity", "quantum", "rate")

    def __init__(self, rate_bps: float, mtu: int, burst: int, now: float) -> None:
        self.rate = rate_bps / 8
        """Bytes per second."""
        self._mtu = mtu
        self.capacity = max(2.0 * mtu, self.rate * BUCKET_TIME)
        self.quantum = min(max(self.rate * QUANTUM_TIME, mtu), burst)
        """Bytes that a large message waits for, so that it goes in few batches."""
        self._tokens = self.capacity
        self._updated = now

    def budget(self, now: float) -> float:
        """Bytes that may be sent now; zero or less means wait."""
        if now > self._updated:
            self._tokens = min(self.capacity, self._tokens + (now - self._updated) * self.rate)
            self._updated = now
        return self._tokens

    def spend(self, size: int) -> None:
        """Account for ``size`` bytes sent."""
        self._tokens -= size

    def ready_at(self, need: float) -> float:
        """When ``need`` bytes may be sent, as of the last `budget`."""
        missing = min(need, self.capacity) - self._tokens
        return self._updated if missing <= 0 else self._updated + missing / self.rate + ROUNDING
