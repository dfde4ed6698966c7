"""Real time for a process, where that is permitted: SCHED_FIFO, and memory that is never swapped out."""

from __future__ import annotations

import os
import resource

GUARD, WRITER, GATE = 30, 25, 20
"""Priorities; threads of the kernel that handle interrupts have 50."""
_LOCK_CURRENT, _LOCK_FUTURE, _LOCK_WHEN_USED = 1, 2, 4
_MAY_LOCK = 1 << 14
"""CAP_IPC_LOCK."""


def acquire(priority: int) -> list[str]:
    """Take what is permitted.

    Args:
        priority: Of SCHED_FIFO. Threads that are started later have it, too: one that was held up with Python's lock
            in its hand would hold up all.

    Returns:
        What was not permitted, a sentence each; empty: all was.
    """
    refused = []
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except (OSError, AttributeError) as error:
        why = _why(error)
        refused.append(f"real-time scheduling (SCHED_FIFO) is not permitted: {why}; LimitRTPRIO={priority} permits it")
    why = _lock_memory()
    if why:
        refused.append(f"locking memory (mlockall) is not permitted: {why}; LimitMEMLOCK=infinity permits it")
    return refused


def _lock_memory() -> str:
    """Why it could not be; empty: it was. With a bounded permission later memory would be refused, so that is none."""
    soft, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    if soft != resource.RLIM_INFINITY and not _has_capability():
        return f"the limit is {soft // 1024} KiB"
    try:
        import ctypes

        library = ctypes.CDLL(None, use_errno=True)
        if library.mlockall(_LOCK_CURRENT | _LOCK_FUTURE | _LOCK_WHEN_USED):
            return os.strerror(ctypes.get_errno())
    except (ImportError, OSError, AttributeError) as error:
        return _why(error)
    return ""


def _has_capability() -> bool:
    try:
        with open("/proc/self/status", encoding="ascii", errors="replace") as file:
            effective = [line.split()[1] for line in file if line.startswith("CapEff:")]
        return bool(effective) and int(effective[0], 16) & _MAY_LOCK != 0
    except (OSError, ValueError, IndexError):
        return False


def _why(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error)
