"""The log of a running pod, as the API server sends it."""

from __future__ import annotations

import queue
import threading
from contextlib import suppress

import urllib3

from ..base import LogStream
from .cluster import Cluster, cut

_SILENCE_S = 3600.0
"""A connection over which nothing came for so long is given up; whoever looks may look again."""
_LOOK_S = 1.0
_WAITING = 16
"""Pieces, of 64 KiB at most, that wait for a slow reader; then the API server waits too."""


class PodLog(LogStream):
    """Follows one run of a service; a thread reads, for a read cannot be given up."""

    def __init__(self, cluster: Cluster, pod: str, lines: int) -> None:
        self._cluster = cluster
        self._path = cluster.path("pods", f"{pod}/log")
        self._lines = lines
        self._pieces: queue.Queue[bytes | None] = queue.Queue(_WAITING)
        self._closed = threading.Event()
        self._answer: urllib3.HTTPResponse | None = None
        threading.Thread(target=self._pump, name="kubernetes-log", daemon=True).start()

    def _pump(self) -> None:
        with (
            suppress(Exception),  # however the connection ends, the log has
            self._cluster.stream(self._path, _SILENCE_S, follow="true", tailLines=self._lines) as answer,
        ):
            self._answer = answer
            while not self._closed.is_set() and (piece := answer.read1(1 << 16)):
                self._put(piece)
        self._answer = None
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
        answer = self._answer
        if answer is not None:
            with suppress(Exception):  # it may have ended by itself
                cut(answer)
