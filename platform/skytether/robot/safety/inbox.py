"""Where the threads of a graph put readings, and the gate's loop takes them."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Mapping

from skytether.messages import DecodeError, Encoding, Message, decode

_WAITING = 64
"""Readings that wait for the gate's next turn; the newest are kept."""


class Inbox:
    """Readings as bytes, decoded when they are taken.

    Args:
        kinds: Message type by topic, as configured.
        encoding: Of the graph.
        trouble: Told a kind and a sentence about each reading that is not used.
    """

    def __init__(
        self, kinds: Mapping[str, type[Message]], encoding: Encoding, trouble: Callable[[str, str], object]
    ) -> None:
        self._kinds = kinds
        self._encoding = encoding
        self._trouble = trouble
        self._lock = threading.Lock()
        self._waiting: deque[tuple[str, bytes | memoryview]] = deque(maxlen=_WAITING)

    def put(self, topic: str, data: bytes | memoryview) -> None:
        """From any thread: a reading came."""
        with self._lock:
            self._waiting.append((topic, data))

    def take(self) -> list[tuple[str, Message]]:
        """What came since the last call, oldest first."""
        with self._lock:
            waiting, self._waiting = self._waiting, deque(maxlen=_WAITING)
        found = []
        for topic, data in waiting:
            try:
                found.append((topic, decode(self._kinds[topic], data, self._encoding)))
            except DecodeError as error:
                self._trouble(f"sensors:{topic}:bytes", f"{topic}: {error}")
        return found
