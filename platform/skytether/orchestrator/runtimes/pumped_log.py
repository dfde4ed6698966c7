"""A log that comes over a connection."""

from __future__ import annotations

import queue
import threading
from abc import abstractmethod
from collections.abc import Iterator
from contextlib import suppress

from .base import LogStream

SILENCE_S = 3600.0
"""A connection over which nothing came for so long is given up; whoever looks may look again."""
_LOOK_S = 1.0
_WAITING = 16
"""Pieces, of 64 KiB at most, that wait for a slow reader; then the other end waits too. A service may write as fast as
it can, its robot may follow it dozens of times, and read none of it."""


class PumpedLog(LogStream):
    """Follows one run of a service; a thread reads, for a read cannot be given up."""

    def __init__(self, thread: str) -> None:
        """``thread``: its name."""
        self._pieces: queue.Queue[bytes | None] = queue.Queue(_WAITING)
        self._closed = threading.Event()
        threading.Thread(target=self._pump, name=thread, daemon=True).start()

    @abstractmethod
    def _arriving(self) -> Iterator[bytes]:
        """What arrives, piece by piece, until the run ends; whatever it raises is the end."""

    @abstractmethod
    def _let_go(self) -> None:
        """End what ``_arriving`` waits for; whatever it raises is passed over."""

    def _pump(self) -> None:
        with suppress(Exception):  # however the connection ends, the log has
            for piece in self._arriving():
                self._put(piece)
        self._put(None)

    def _put(self, piece: bytes | None) -> None:
        while not self._closed.is_set():
            with suppress(queue.Full):
                self._pieces.put(piece, timeout=_LOOK_S)
                return

    def read(self) -> str | None:
        try:
            piece = self._pieces.get(timeout=_LOOK_S)
        except queue.Empty:
            return None if self._closed.is_set() else ""
        return None if piece is None else piece.decode(errors="replace")

    def close(self) -> None:
        self._closed.set()
        with suppress(Exception):  # it may have ended by itself
            self._let_go()
