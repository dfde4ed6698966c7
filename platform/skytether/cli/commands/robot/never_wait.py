"""Standard output and error that nobody has to read: no command waits for the pipe or disk behind what it prints."""

from __future__ import annotations

import atexit
import io
import os
import sys
import threading
import time

_MOST_BYTES = 256 * 1024
"""That wait at most: some thousand lines. What does not fit is dropped."""
_DRAIN_S = 1.0
"""At the end of the program, for what still waits."""
_AGAIN_S = 0.05
"""Before another try, where whoever owns the descriptor made it non-blocking."""


class NeverWaits(io.TextIOBase):
    """A text stream whose writes return at once; a thread of its own writes to the descriptor.

    It writes by the descriptor alone, so that the interpreter finds no lock held when it ends.

    Args:
        stream: What it takes the place of.
        descriptor: Of the stream.
    """

    def __init__(self, stream: io.TextIOBase, descriptor: int) -> None:
        self._stream = stream
        self._descriptor = descriptor
        self._tty = stream.isatty()
        self._encoding = stream.encoding or "utf-8"
        self._changed = threading.Condition()
        self._waiting = bytearray()
        self._writing = False
        threading.Thread(target=self._run, name="output", daemon=True).start()

    @property
    def encoding(self) -> str:  # type: ignore[override]  # typeshed has an attribute
        """As of the stream."""
        return self._encoding

    def isatty(self) -> bool:
        """As of the stream."""
        return self._tty

    def fileno(self) -> int:
        """The descriptor."""
        return self._descriptor

    def writable(self) -> bool:
        """Yes."""
        return True

    def write(self, text: str) -> int:
        """Take a text; dropped if too much waits already."""
        data = text.encode(self._encoding, "replace")
        with self._changed:
            if len(self._waiting) + len(data) <= _MOST_BYTES:
                self._waiting += data
                self._changed.notify_all()
        return len(text)

    def flush(self) -> None:
        """Nothing is waited for; see `drain`."""

    def drain(self, seconds: float) -> None:
        """Wait until all is written, that long at most [s]."""
        with self._changed:
            self._changed.wait_for(lambda: not (self._waiting or self._writing), seconds)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._writing = False
                self._changed.notify_all()
                self._changed.wait_for(lambda: self._waiting)
                data, self._waiting, self._writing = self._waiting, bytearray(), True
            left = memoryview(data)
            while left:
                try:
                    left = left[os.write(self._descriptor, left) :]
                except BlockingIOError:
                    time.sleep(_AGAIN_S)
                except OSError:  # the reader is gone, or the disk is full
                    break


def never_wait() -> None:
    """From here on nothing that this program prints is waited for, at its end for a second."""
    streams = []
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        try:
            stream.flush()
            replaced = NeverWaits(stream, stream.fileno())
        except (AttributeError, OSError, ValueError):  # closed, or not a file: a test's
            continue
        setattr(sys, name, replaced)
        streams.append(replaced)
    for replaced in streams:
        atexit.register(replaced.drain, _DRAIN_S)
