"""A command that runs until it is interrupted or terminated, and then ends in order."""

from __future__ import annotations

import signal
from contextlib import suppress
from queue import Empty, SimpleQueue


class EndSignal:
    """SIGINT and SIGTERM, from now on, as something to wait for in the main thread.

    `threading.Event` would not do: its `set` takes a lock that `wait` takes, too, and a handler runs in the thread that
    waits, which would then wait for itself. `SimpleQueue.put` may be called in handlers.
    """

    def __init__(self) -> None:
        self._came: SimpleQueue[int] = SimpleQueue()
        self.came = False
        """Whether `wait` has seen one."""
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda number, _: self._came.put(number))

    def wait(self, timeout: float | None = None) -> bool:
        """Until one comes, or for so long [s]; None: for ever. Returns whether one has come, now or before."""
        with suppress(Empty):
            if not self.came:
                self._came.get(timeout=timeout)
                self.came = True
        return self.came
