"""A slower processor for programs that run here: they are stopped for a while whenever they have had their share.

Works on any processes of this user (or of anybody, for root), without control groups: these belong to root, or to
whoever systemd gave them to. It is what the program cpulimit does. Containers have the engine's own limit instead.
"""

from __future__ import annotations

import contextlib
import os
import signal
import threading
import time
from collections.abc import Callable, Iterable
from types import TracebackType

import psutil

_STEP_S = 0.01
"""Between two looks: a program can overdraw by as much, and pays for it by standing longer."""
_FIND_S = 0.5
"""Between two looks for new processes."""
_CPUCLOCK_SCHED, _CPUCLOCK_PERTHREAD = 2, 4
"""Of <linux/posix-timers.h>."""


class Budget:
    """Processor time that flows in evenly and is spent in bursts, as Linux's CFS quota with a period.

    Args:
        cores: Share, in processors; greater than 0.
        period_s: So much of it can be saved at most: ``cores * period_s`` [s].
    """

    def __init__(self, cores: float, period_s: float = 0.1) -> None:
        if not cores > 0:
            raise ValueError(f"the share must be greater than 0 processors, not {cores}")
        self._cores = cores
        self._most = self._left = cores * period_s

    def spend(self, passed_s: float, used_s: float) -> bool:
        """So much time has passed, so much was used meanwhile; whether it may go on."""
        self._left = min(self._left + self._cores * passed_s, self._most) - used_s
        return self._left > 0


class Throttle:
    """Keeps a set of processes, all of them together, below a share of one processor. A context manager.

    Args:
        cores: Their share, in processors.
        find: Says which processes, by pid; asked again and again.
    """

    def __init__(self, cores: float, find: Callable[[], Iterable[int]]) -> None:
        self._budget = Budget(cores)
        self._find = find
        self._used: dict[int, float] = {}
        """Processor time of each, as seen last [s]."""
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="throttle", daemon=True)
        self.stopped_s = 0.0
        """For how long they were stopped so far."""

    def __enter__(self) -> Throttle:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ending.set()
        self._thread.join()

    def _run(self) -> None:
        going, last, found_at = True, time.monotonic(), -_FIND_S
        try:
            while not self._ending.wait(_STEP_S):
                now = time.monotonic()
                if now - found_at > _FIND_S:
                    self._find_new()
                    found_at = now
                if not going:
                    self.stopped_s += now - last
                may = self._budget.spend(now - last, self._spent())
                if may != going:
                    self._signal(signal.SIGCONT if may else signal.SIGSTOP)
                    going = may
                last = now
        finally:
            self._signal(signal.SIGCONT)

    def _find_new(self) -> None:
        """Take in those that are new: what they used before is not counted."""
        pids = set(self._find())
        self._used = {pid: self._used.get(pid, cpu_time(pid)) for pid in pids}

    def _spent(self) -> float:
        """By all of them since the last call [s]."""
        before, self._used = self._used, {pid: cpu_time(pid) for pid in self._used}
        return sum(max(used - before[pid], 0.0) for pid, used in self._used.items())

    def _signal(self, number: signal.Signals) -> None:
        for pid in self._used:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, number)


def cpu_time(pid: int) -> float:
    """Processor time of a process so far [s]; 0 of one that is gone. To the nanosecond, where /proc counts 10 ms."""
    with contextlib.suppress(OSError):
        return time.clock_gettime((~pid << 3) | _CPUCLOCK_SCHED)  # MAKE_PROCESS_CPUCLOCK
    return 0.0


def native_threads_time() -> float:
    """Processor time so far of this process's threads that are not Python's, as a library's that draws [s].

    Of those that run: what ended meanwhile is not in it.
    """
    ours = {thread.native_id for thread in threading.enumerate()}
    total = 0.0
    for tid in map(int, os.listdir("/proc/self/task")):
        if tid not in ours:
            with contextlib.suppress(OSError):
                total += time.clock_gettime((~tid << 3) | _CPUCLOCK_PERTHREAD | _CPUCLOCK_SCHED)  # MAKE_THREAD_CPUCLOCK
    return total


def children_of(pid: int) -> list[int]:
    """All that a process started, and what these started."""
    try:
        return [child.pid for child in psutil.Process(pid).children(recursive=True)]
    except psutil.NoSuchProcess:
        return []
