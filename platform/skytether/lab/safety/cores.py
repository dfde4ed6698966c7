"""Other programs that take all processor cores."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

_PER_CORE = 2
_SPIN = "import os\nwhile os.getppid() == {parent}: sum(range(100000))"
"""Ends with whoever started it."""


@contextmanager
def busy_cores() -> Iterator[None]:
    """Two programs for each core, of ordinary priority, that never wait."""
    command = [sys.executable, "-c", _SPIN.format(parent=os.getpid())]
    spinning = [subprocess.Popen(command, stdin=subprocess.DEVNULL) for _ in range(_PER_CORE * (os.cpu_count() or 1))]
    try:
        yield
    finally:
        for process in spinning:
            process.kill()
            process.wait()
