"""Wakes those who wait for an instance's next event. A hint, never the truth: the truth is in the store."""

from __future__ import annotations

import asyncio
import threading
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager


class Broker:
    """From the threads that change instances to the event loops that tell of it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiting: dict[str, set[tuple[asyncio.AbstractEventLoop, asyncio.Event]]] = defaultdict(set)
        self.closed = False

    @contextmanager
    def subscribe(self, instance: str) -> Iterator[asyncio.Event]:
        """In a coroutine: an event that is set at each change of the instance, and when the broker closes."""
        entry = (asyncio.get_running_loop(), asyncio.Event())
        with self._lock:
            self._waiting[instance].add(entry)
        try:
            yield entry[1]
        finally:
            with self._lock:
                self._waiting[instance].discard(entry)
                if not self._waiting[instance]:
                    del self._waiting[instance]

    def publish(self, instance: str) -> None:
        """Wake those who wait for this instance; from any thread."""
        with self._lock:
            self._wake(self._waiting.get(instance, ()))

    def close(self) -> None:
        """Let all of them finish."""
        with self._lock:
            self.closed = True
            for entries in self._waiting.values():
                self._wake(entries)

    @staticmethod
    def _wake(entries: set[tuple[asyncio.AbstractEventLoop, asyncio.Event]] | tuple[()]) -> None:
        for loop, event in entries:
            if not loop.is_closed():
                loop.call_soon_threadsafe(event.set)
