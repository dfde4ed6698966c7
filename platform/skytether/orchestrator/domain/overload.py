"""Whether this orchestrator keeps robots from renewing: then no lease runs out. Nothing here waits or does.

A lease says that its robot is gone. Who was refused for want of room, or was left waiting, is not gone; so as long as
that is so, and once it is over until each lease has begun anew, nothing is ended for a lease.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

HOLD = 3.0
"""Seconds that a refusal counts: who was told to come again in a second has come by then."""
LATE = 1.0
"""Seconds after which a renewal that is not answered, or a loop that does not turn, counts as a refusal."""


class Overload:
    """Notes what keeps robots from renewing. Safe from any thread."""

    def __init__(self, steady: Callable[[], float] = time.monotonic) -> None:
        """``steady`` gives seconds of a clock that nobody sets."""
        self._steady = steady
        self._lock = threading.Lock()
        self._noted_at: float | None = None
        self._beat_at: float | None = None
        self._renewals: dict[int, float] = {}
        """When those under way began; as many as requests are at once."""
        self._number = 0
        self._owed = False

    def note(self) -> None:
        """Somebody was refused who may have wanted to renew a lease."""
        with self._lock:
            self._note(self._steady())

    def beat(self) -> None:
        """The loop that answers requests turns; from the first call on it is missed when it does not."""
        with self._lock:
            now = self._steady()
            if self._beat_at is not None and now - self._beat_at > LATE:
                self._note(now)
            self._beat_at = now

    def rest(self) -> None:
        """The loop has ended in order: it is missed no more."""
        with self._lock:
            self._beat_at = None

    @contextmanager
    def renewing(self) -> Iterator[None]:
        """Around each renewal, from the moment when all of it has arrived."""
        with self._lock:
            number = self._number = self._number + 1
            self._renewals[number] = self._steady()
        try:
            yield
        finally:
            with self._lock:
                self._check(self._steady())
                del self._renewals[number]

    def felt(self) -> bool:
        """Whether a lease that has run out says nothing now."""
        with self._lock:
            now = self._steady()
            self._check(now)
            return self._noted_at is not None and now - self._noted_at < HOLD

    def owed(self) -> bool:
        """Whether it is over, and leases are to count anew from now; true once."""
        if self.felt():
            return False
        with self._lock:
            owed, self._owed = self._owed, False
            return owed

    def _check(self, now: float) -> None:
        late = self._beat_at is not None and now - self._beat_at > LATE
        if late or any(now - began > LATE for began in self._renewals.values()):
            self._note(now)

    def _note(self, now: float) -> None:
        self._noted_at, self._owed = now, True
