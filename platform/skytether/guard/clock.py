"""The clock of guard, gate and the agent's link to it."""

from __future__ import annotations

import time


def now() -> float:
    """Seconds since the machine started [s], also while it was suspended.

    CLOCK_MONOTONIC stands still in a suspend: what was said before it would look fresh afterwards. No clock that people
    or servers can set is ever used. All processes of one machine have the same.
    """
    return time.clock_gettime(time.CLOCK_BOOTTIME)
