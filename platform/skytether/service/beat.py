"""Shows that a service's loop is alive, for the health check of its container.

A thread of its own touches the ready file; it stops while one step takes too long, and with the process.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from .health import BEAT_S, SILENT_S


def touch(path: str, in_step_for: float) -> bool:
    """Touch the file unless a step has taken ``in_step_for`` [s], too long; tells whether it did."""
    if in_step_for >= SILENT_S:
        return False
    with suppress(OSError):  # whoever removed it has no use for it
        os.utime(path)
    return True


@contextmanager
def beating(
    path: str | None,
    in_step_for: Callable[[], float],
    period: float = BEAT_S,
    on_beat: Callable[[], None] = lambda: None,
) -> Iterator[None]:
    """Touch the ready file every ``period`` seconds, and call ``on_beat`` as often; None: there is none."""
    ended = threading.Event()

    def beat() -> None:
        while path is not None and not ended.wait(period):
            touch(path, in_step_for())
            on_beat()

    thread = threading.Thread(target=beat, name="beat", daemon=True)
    if path is not None:
        thread.start()
    try:
        yield
    finally:
        ended.set()
        if path is not None:
            thread.join()
