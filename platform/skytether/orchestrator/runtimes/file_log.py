"""A run's log as a file: followed, cut, and what its last line says."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path

from .base import LogStream

_LAST_LINE = 300
"""Characters of a log's last line that are told."""


class FileLog(LogStream):
    """Follows a log file; one that was cut is read on from where it is then."""

    def __init__(self, path: Path, lines: int, ended: Callable[[], bool], poll: float = 0.1) -> None:
        """``lines``: to begin with; ``ended``: whether no more will come; ``poll``: seconds between two looks."""
        self._path = path
        self._ended = ended
        self._poll = poll
        with path.open("rb") as file:
            self._before = b"".join(deque(file, maxlen=lines)).decode(errors="replace")
            self._at = file.tell()
        self._closed = threading.Event()

    def read(self) -> str | None:
        if self._before:
            text, self._before = self._before, ""
            return text
        deadline = time.monotonic() + 1
        while not self._closed.is_set():
            ended = self._ended()  # before the look: what is written until then is read
            new = self._new()
            if new:
                return new
            if ended:
                return None
            if time.monotonic() >= deadline:
                return ""
            self._closed.wait(self._poll)
        return None

    def _new(self) -> str:
        with contextlib.suppress(FileNotFoundError), self._path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            file.seek(min(self._at, size))
            content = file.read()
            self._at = file.tell()
            return content.decode(errors="replace")
        return ""

    def close(self) -> None:
        self._closed.set()


def keep_newer_half(log: Path, keep: int) -> None:
    """Cut in place: the service has the file open for appending. What it writes in this very moment may be lost."""
    with log.open("rb+") as file:
        file.seek(-keep, os.SEEK_END)
        file.readline()
        newer = file.read()
        file.truncate(0)
    with log.open("ab") as file:
        file.write(newer)


def last_line(log: Path) -> str:
    """The last line with anything in it, as far as it can be read; empty: there is none."""
    with contextlib.suppress(FileNotFoundError), log.open("rb") as file:
        file.seek(max(0, log.stat().st_size - 8192))
        lines = file.read().decode(errors="replace").split("\n")
        for line in reversed(lines):
            readable = "".join(c for c in line if c.isprintable()).strip()
            if readable:
                return readable[:_LAST_LINE]
    return ""
