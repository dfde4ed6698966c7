"""Real time for a node that is there, and none for its start: that takes both cores of a robot for half a second.

Whoever starts this program in real time hands that on, and wheels and sensors on the same computer would wait for it.
"""

from __future__ import annotations

import contextlib
import os
from typing import Any

Schedule = tuple[int, Any]


def leave() -> Schedule:
    """Be scheduled as others are; gives what it was before."""
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    return before


def resume(before: Schedule) -> None:
    """Be scheduled so again, with all threads that there are; those that are started later have it from these."""
    policy, parameter = before
    if policy == os.SCHED_OTHER:
        return
    for thread in os.listdir("/proc/self/task"):
        with contextlib.suppress(OSError):  # it has ended, or it is not permitted any more
            os.sched_setscheduler(int(thread), policy, parameter)
