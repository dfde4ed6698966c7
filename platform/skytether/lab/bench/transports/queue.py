"""A queue in front of a transport that may have to wait: when it is full the oldest message is dropped."""

from __future__ import annotations

import threading
from collections import deque


class LatestQueue:
    """Bounded, for one or more producers and one consumer."""

    def __init__(self, depth: int) -> None:
        self._items: deque[bytes] = deque(maxlen=depth)
        self._changed = threading.Condition()
        self._closed = False

    def put(self, payload: bytes) -> None:
        """Add a message; never waits."""
        with self._changed:
            self._items.append(payload)
            self._changed.notify()

    def get(self) -> bytes | None:
        """Wait for the next message; None once closed."""
        with self._changed:
            while not self._items and not self._closed:
                self._changed.wait()
            return None if self._closed else self._items.popleft()

    def close(self) -> None:
        """End the consumer's wait."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
