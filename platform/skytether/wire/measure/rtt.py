"""How long to wait for an acknowledgement, from the round trips that pings measure (RFC 6298, section 2)."""

from __future__ import annotations

ACK_DELAY = 0.005
"""Seconds for which the receiver of a reliable topic collects what it acknowledges."""
FIRST = 0.2
"""Seconds before anything is known of the path."""
LEAST_SPREAD = 0.01
"""Seconds of variation assumed at least: machines are late too."""
LONGEST = 1.0
"""Seconds between attempts at most: who was away is found again by other means (`Session`)."""


class RttEstimator:
    """Smoothed round trip, its variation, and the timeout of retransmissions that follows from them."""

    __slots__ = ("_mean", "_spread")

    def __init__(self) -> None:
        self._mean = -1.0
        self._spread = 0.0

    def add(self, seconds: float) -> None:
        """Take a measured round trip; NaN (none was measured yet) changes nothing."""
        if seconds != seconds:
            return
        if self._mean < 0:
            self._mean, self._spread = seconds, seconds / 2
        else:
            self._spread += (abs(self._mean - seconds) - self._spread) / 4
            self._mean += (seconds - self._mean) / 8

    @property
    def timeout(self) -> float:
        """Seconds after which what was sent should be known to have arrived."""
        if self._mean < 0:
            return FIRST
        return self._mean + max(4 * self._spread, LEAST_SPREAD) + ACK_DELAY

    def timeout_after(self, attempts: int) -> float:
        """Seconds before the next attempt when so many were in vain."""
        return max(self.timeout, min(self.timeout * (1 << min(attempts, 10)), LONGEST))
