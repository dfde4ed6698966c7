"""What waits in front of a transport that may have to wait: bounded for each topic, the oldest is dropped."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Mapping


class LatestQueue:
    """For several producers and one consumer, who gets the most important first."""

    def __init__(self, topics: Mapping[int, tuple[int, int]]) -> None:
        """Make it.

        Args:
            topics: Rank (1 first) and depth by index.
        """
        ranked = sorted(topics, key=lambda index: topics[index][0])
        self._waiting: dict[int, deque[bytes]] = {index: deque(maxlen=topics[index][1]) for index in ranked}
        self._changed = threading.Condition()
        self._closed = False

    def put(self, index: int, payload: bytes) -> None:
        """Add a message; never waits."""
        with self._changed:
            self._waiting[index].append(payload)
            self._changed.notify()

    def get(self) -> tuple[int, bytes] | None:
        """Wait for the next message, and whose it is; None once closed."""
        with self._changed:
            while not self._closed:
                for index, messages in self._waiting.items():
                    if messages:
                        return index, messages.popleft()
                self._changed.wait()
            return None

    def close(self) -> None:
        """End the consumer's wait."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
