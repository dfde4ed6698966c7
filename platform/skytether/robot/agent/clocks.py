"""The clocks by which the agent finds out that it stood still (`control.stall`)."""

from __future__ import annotations

import time


def read_clocks() -> tuple[float, float | None]:
    """Both clocks of this computer now, in the order of `skytether.robot.control.stall.StallWatch.tick`."""
    boot = time.clock_gettime(time.CLOCK_BOOTTIME) if hasattr(time, "CLOCK_BOOTTIME") else None
    return time.monotonic(), boot
