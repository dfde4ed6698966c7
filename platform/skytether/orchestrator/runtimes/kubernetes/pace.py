"""How fast an API server is asked: evenly, after a burst, and not at all while it says that it has too much to do."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable


class Pace:
    """At most ``burst`` calls at once, and ``per_s`` a second on average: in no second more than both together.

    From any thread. It is the generic cell rate algorithm (ITU-T I.371): only the time of the next turn is kept.
    """

    def __init__(
        self,
        per_s: float,
        burst: int,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """``clock`` is monotonic [s]."""
        self._every_s = 1.0 / per_s
        self._ahead_s = (burst - 1) / per_s
        self._clock, self._sleep = clock, sleep
        self._lock = threading.Lock()
        self._turn = clock()
        """Of the next call, if none comes sooner than it may."""
        self._held_until = self._turn

    def wait(self) -> None:
        """Until it is the caller's turn."""
        with self._lock:
            now = self._clock()
            turn = max(self._turn, now)
            self._turn = turn + self._every_s
            begin = max(turn - self._ahead_s, self._held_until)
        if begin > now:
            self._sleep(begin - now)

    def hold(self, seconds: float) -> None:
        """Have all wait that come from now on."""
        with self._lock:
            self._held_until = max(self._held_until, self._clock() + seconds)
