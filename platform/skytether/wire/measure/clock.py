"""Offset between the peer's clock and ours, with a bound of its error that always holds.

Every exchange of time stamps (t1 we sent, t2 peer received, t3 peer sent, t4 we received) bounds the offset by
causality alone: ``t3 - t4 <= offset <= t2 - t1``, whatever the delays. The tightest bounds of each direction are
kept; they loosen by the drift that two clocks may have, so old ones fade by themselves. The error is half the sum
of the shortest delays seen each way, never more than half the best round trip (Cristian 1989; RFC 5905).
"""

from __future__ import annotations

import math

MAX_DRIFT = 100e-6
"""Seconds per second by which two quartz clocks may diverge (RFC 5905 assumes 15e-6 for a disciplined one)."""


class ClockOffset:
    """Peer's monotonic clock minus ours, in seconds."""

    __slots__ = ("_high", "_low", "_updated", "error", "known", "offset")

    def __init__(self) -> None:
        self._low = -math.inf
        self._high = math.inf
        self._updated = 0.0
        self.known = False
        self.offset = math.nan
        """Best estimate; NaN before the first exchange."""
        self.error = math.inf
        """The true offset is within ``offset +- error``, as of the last exchange; inf before the first."""

    def error_at(self, when: float) -> float:
        """The same for a moment of the peer's, before or after, that is known as well as the offset: clocks drift."""
        return self.error + (abs(when - self._updated) + self.error) * MAX_DRIFT

    def exchange(self, t1: float, t2: float, t3: float, t4: float) -> None:
        """Take one exchange: t1, t4 on our clock, t2, t3 on the peer's."""
        age = max(0.0, t4 - self._updated) * MAX_DRIFT
        newest_low, newest_high = t3 - t4, t2 - t1 + (t4 - t1) * MAX_DRIFT
        low, high = max(self._low - age, newest_low), min(self._high + age, newest_high)
        if low > high:  # a clock jumped (a suspended machine): only the newest exchange counts
            low, high = newest_low, newest_high
        if low > high:  # no clock runs like that: a peer that makes up time stamps
            return
        self._low, self._high, self._updated = low, high, t4
        self.known, self.offset, self.error = True, (low + high) / 2, (high - low) / 2
