"""A thread that runs one step again and again, and can be woken."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

log = logging.getLogger(__name__)

_AFTER_ERROR = 1.0
"""Seconds until the next pass after one that raised."""

_SHARE = 0.1
"""Of the time, at most, for which each loop looks at all instances again and again: of many thousands, less often."""


class Loop:
    """Calls ``step``, which says in how many seconds it wants to be called again; ``wake`` makes that now."""

    def __init__(
        self,
        name: str,
        step: Callable[[], float],
        clock: Callable[[], float],
        after_error_s: float = _AFTER_ERROR,
    ) -> None:
        """``clock`` is monotonic; it only dates and times the passes."""
        self._step = step
        self._after_error_s = after_error_s
        self._clock = clock
        self._wake = threading.Event()
        self._ending = False
        self._first = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self.last_pass = clock()
        """When the last pass ended."""

    def start(self) -> None:
        self._thread.start()

    def wake(self) -> None:
        """Make a pass now; safe from any thread."""
        self._wake.set()

    def wait_first(self, timeout: float) -> bool:
        """Wait until the first pass is done."""
        return self._first.wait(timeout)

    def stop(self, timeout: float) -> None:
        """End after the present pass; the timeout is for one that hangs in a runtime."""
        self._ending = True
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join(timeout)

    def _run(self) -> None:
        while not self._ending:
            began = self._clock()
            self._wake.clear()  # before the step: a wake during it is not lost
            try:
                delay = self._step()
            except Exception:
                # Whatever it is, the next pass looks at everything anew; a dead loop would mend nothing.
                log.exception("%s: pass failed, trying again", self._thread.name)
                delay = self._after_error_s
            self.last_pass = self._clock()
            log.debug("%s: pass of %.2f ms", self._thread.name, (self.last_pass - began) * 1e3)
            self._first.set()
            self._wake.wait(delay)


def rest_of(usual: float, took: float) -> float:
    """Seconds from one look at all until the next, for one that took so many of a processor's."""
    return max(usual, took / _SHARE)
