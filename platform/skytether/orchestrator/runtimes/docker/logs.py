"""The log of a running container, as the engine sends it."""

from __future__ import annotations

import queue
import threading
from contextlib import suppress
from typing import Any

from ..base import LogStream
from .engine import Engine

_SILENCE_S = 3600.0
"""A connection over which nothing came for so long is given up; whoever looks may look again."""
_LOOK_S = 1.0
_WAITING = 16
"""Pieces, of 64 KiB at most, that wait for a slow reader; then the engine waits too. A service may write as fast as it
can, its robot may follow it dozens of times, and read none of it."""


class ContainerLog(LogStream):
    """Follows one run of a container; a thread reads, for a read cannot be given up."""

    def __init__(self, engine: Engine, container: str, lines: int) -> None:
        with engine.asked():
            api = engine.api(_SILENCE_S)
            self._stream: Any = api.logs(container, stream=True, follow=True, tail=lines)
        self._pieces: queue.Queue[bytes | None] = queue.Queue(_WAITING)
        self._closed = threading.Event()
        threading.Thread(target=self._pump, name="docker-log", daemon=True).start()

    def _pump(self) -> None:
        with suppress(Exception):  # however the connection ends, the log has
            for piece in self._stream:
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
            self._stream.close()
