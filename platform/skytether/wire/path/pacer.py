"""A path's budget in bits per second (rule 6): a token bucket. Which rate it has is for `congestion` to say."""

from __future__ import annotations

import math

BUCKET_TIME = 0.003
"""Seconds of sending that may be saved up: covers late timers, and bounds the queue a burst makes on the link."""
QUANTUM_TIME = 0.002
"""Seconds of sending worth waking up for in the midst of a large message: a camera frame of 47 kB at 50 Mbit/s goes in
four or five system calls, and what is more urgent waits in the link for no more than this."""

BURST = 10_000
"""Bytes sent between two reports of the peer whose way tells what a path is good for: most of a TCP's first window."""
ROUNDING = 1e-6
"""Seconds added to a time of waiting, so that rounding never makes it end too early to send anything."""


class Pacer:
    """Sending is allowed while tokens are positive; the last packet may overdraw them by its size."""

    __slots__ = (
        "_burst", "_mtu", "_spent", "_tokens", "_updated", "_waited", "burst_at", "capacity", "quantum", "rate",
    )  # fmt: skip

    def __init__(self, rate_bps: float, mtu: int, burst: int, now: float) -> None:
        self._mtu = mtu
        self._burst = burst
        self.rate = self.capacity = self.quantum = 0.0
        self.set_rate(rate_bps)
        self._tokens = self.capacity
        self._updated = now
        self._spent = 0
        self._waited = False
        self.burst_at = math.inf
        """When the first `BURST` was sent."""

    def set_rate(self, rate_bps: float) -> None:
        """From now on; what is saved up remains."""
        self.rate = rate_bps / 8
        """Bytes per second."""
        self.capacity = max(float(self._mtu), self.rate * BUCKET_TIME)
        self.quantum = min(max(self.rate * QUANTUM_TIME, self._mtu), self._burst)
        """Bytes that a large message waits for, so that it goes in few batches."""

    def budget(self, now: float) -> float:
        """Bytes that may be sent now; zero or less means wait."""
        if now > self._updated:
            self._tokens = min(self.capacity, self._tokens + (now - self._updated) * self.rate)
            self._updated = now
        return self._tokens

    def spend(self, size: int) -> None:
        """Account for ``size`` bytes sent."""
        self._tokens -= size
        self._spent += size
        if self._spent >= BURST and self.burst_at == math.inf:
            self.burst_at = self._updated

    def usage(self) -> tuple[int, bool]:
        """Bytes sent, and whether anything waited for its turn, since the last call."""
        usage = self._spent, self._waited
        self._spent, self._waited = 0, False
        return usage

    def ready_at(self, need: float) -> float:
        """When ``need`` bytes may be sent, as of the last `budget`."""
        self._waited = True
        missing = min(need, self.capacity) - self._tokens
        return self._updated if missing <= 0 else self._updated + missing / self.rate + ROUNDING
