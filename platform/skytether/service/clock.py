"""Time as the loop sees it, so that a test can make it up."""

from __future__ import annotations

import os
import select
import time
from typing import Protocol


class Clock(Protocol):
    """A monotonic clock that can be slept on."""

    def now(self) -> float:
        """Seconds."""
        ...

    def sleep_until(self, deadline: float) -> None:
        """Return at ``deadline`` (inf: never), or as soon as `wake` was called since the last sleep."""
        ...

    def wake(self) -> None:
        """End the sleep; from any thread, also from a signal handler."""
        ...


class SystemClock:
    """The machine's. Its sleep ends on an eventfd: the locks of `threading` must not be taken in a signal handler."""

    def __init__(self) -> None:
        self._event = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)

    def now(self) -> float:
        return time.monotonic()

    def sleep_until(self, deadline: float) -> None:
        timeout = max(0.0, min(deadline - time.monotonic(), 3600.0))
        if select.select([self._event], [], [], timeout)[0]:
            os.eventfd_read(self._event)

    def wake(self) -> None:
        os.eventfd_write(self._event, 1)

    def close(self) -> None:
        """Give the descriptor back; not while another thread may still wake."""
        os.close(self._event)
