"""Whoever is about to publish velocities says so where the one who takes the wheels over sees it, and ends it there.

Between its last look at the clock and the kernel a process may be frozen, and would go on with that one velocity,
whatever the wheels were told meanwhile.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager

_PAGE = 4096


class Speaking:
    """A lock on one byte of a file, that of this process's number, which the kernel shows to whoever has the file.

    Args:
        file: Its descriptor.
        start: The byte of number 0.
    """

    def __init__(self, file: int, start: int) -> None:
        self._file = file
        self._byte = start + os.getpid()

    def page(self) -> bytes:
        """What those who tell the wheels something have written down in that file."""
        return os.pread(self._file, _PAGE, 0)

    @contextmanager
    def __call__(self) -> Iterator[None]:
        """While this process looks at the clock, and publishes; from one thread."""
        fcntl.lockf(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, self._byte)
        try:
            yield
        finally:
            fcntl.lockf(self._file, fcntl.LOCK_UN, 1, self._byte)
