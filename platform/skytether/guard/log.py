"""Lines for people on standard error, which is never waited for."""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from math import inf

_WAITING_LINES = 256
"""For a reader that does not read; further ones are dropped and counted."""
_KINDS = 64
_QUIET_S = 30.0
"""A trouble that did not show for this long is over: the next is a new one."""
_CLOSE_S = 0.5
"""For the last lines at the end."""


class Log:
    """Writes lines in a thread of its own.

    Args:
        name: Of the process.
        fd: Where to.
    """

    def __init__(self, name: str, fd: int = 2) -> None:
        self._name = name
        self._fd = fd
        self._lines: deque[str] = deque()
        self._there = threading.Semaphore(0)
        self._dropped = 0
        self._seen: dict[str, float] = {}
        self._written = 0
        self._said = 0
        threading.Thread(target=self._run, name="log", daemon=True).start()

    def line(self, level: str, sentence: str) -> None:
        """Have a line written."""
        if len(self._lines) >= _WAITING_LINES:
            self._dropped += 1
            return
        self._said += 1
        self._lines.append(f"{level} {self._name}: {sentence}\n")
        self._there.release()

    def trouble(self, kind: str, sentence: str, now: float) -> bool:
        """A trouble that may show at every turn is written when it begins. True if it was."""
        before = self._seen.get(kind, -inf)
        if kind not in self._seen and len(self._seen) >= _KINDS:
            return False
        self._seen[kind] = now
        if now - before <= _QUIET_S:
            return False
        self.line("WARNING", sentence)
        return True

    def close(self) -> None:
        """Give the last lines a moment."""
        end = time.monotonic() + _CLOSE_S
        while self._written < self._said and time.monotonic() < end:
            time.sleep(0.01)

    def _run(self) -> None:
        while True:
            self._there.acquire()
            text = self._lines.popleft()
            if self._dropped:
                text += f"WARNING {self._name}: {self._dropped} lines were dropped, nobody read them\n"
                self._dropped = 0
            data = text.encode(errors="replace")
            try:
                while data:
                    data = data[os.write(self._fd, data) :]
            except OSError:  # nobody is there to read it
                pass
            self._written += 1
