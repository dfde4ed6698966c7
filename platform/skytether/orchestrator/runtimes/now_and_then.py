"""What is looked at in a thread, now and then."""

from __future__ import annotations

import threading
from collections.abc import Callable


class NowAndThen:
    """Calls a function in a thread of its own, not oftener than it is due, and never twice at once."""

    def __init__(self, name: str, every_s: float, clock: Callable[[], float], poll: Callable[[], None]) -> None:
        """``name``: of the thread; ``every_s``: from one begin to the next [s]; ``poll`` raises nothing."""
        self._name, self._every_s, self._clock, self._poll = name, every_s, clock, poll
        self._looked_at = -every_s
        self._thread: threading.Thread | None = None

    def begin(self) -> None:
        """Call it, unless that is under way or was begun a moment ago. Does not wait."""
        if self._clock() - self._looked_at < self._every_s or (self._thread is not None and self._thread.is_alive()):
            return
        self._looked_at = self._clock()
        self._thread = threading.Thread(target=self._poll, name=self._name, daemon=True)
        self._thread.start()
