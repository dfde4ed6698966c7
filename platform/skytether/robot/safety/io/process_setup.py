"""What gate and writer have in common as processes: a log that never waits, threads that do not hold up the loop."""

from __future__ import annotations

import logging
import queue
from contextlib import suppress
from logging.handlers import QueueHandler, QueueListener

_WAITING_LINES = 256
"""Lines of the log that wait for whoever reads them; of a reader that does not read, further ones are dropped."""
SWITCH_S = 0.0005
"""For `sys.setswitchinterval`: threads of a ROS node take turns of Python's usual 5 ms, some of them a whole period."""


class _NeverWaits(QueueHandler):
    def enqueue(self, record: logging.LogRecord) -> None:
        with suppress(queue.Full):
            self.queue.put_nowait(record)


def log_without_waiting() -> None:
    """From here on a full disk, or a reader of the log that hangs, costs lines of the log and nothing else."""
    logging.raiseExceptions = False
    root = logging.getLogger()
    handlers = root.handlers[:] or [logging.StreamHandler()]
    if isinstance(handlers[0], _NeverWaits):
        return
    lines: queue.Queue[logging.LogRecord] = queue.Queue(_WAITING_LINES)
    root.handlers[:] = [_NeverWaits(lines)]
    root.setLevel(logging.INFO)
    QueueListener(lines, *handlers, respect_handler_level=True).start()
