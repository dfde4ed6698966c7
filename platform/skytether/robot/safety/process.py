"""What gate and guard share as programs: logs that never wait, and what systemd is told."""

from __future__ import annotations

import logging
import os
import queue
import socket
from contextlib import suppress
from logging.handlers import QueueHandler, QueueListener

_WAITING_LINES = 256
"""Lines of the log that wait for whoever reads them; of a reader that does not read, further ones are dropped."""


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


class Systemd:
    """Tells the service manager how it is going (sd_notify(3)); without one does nothing."""

    def __init__(self) -> None:
        self._address = os.environ.get("NOTIFY_SOCKET", "").replace("@", "\0", 1)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) if self._address else None
        if self._socket is not None:
            self._socket.setblocking(False)

    def tell(self, state: str) -> None:
        """``READY=1``, ``WATCHDOG=1``, ``STATUS=...``, ``STOPPING=1``."""
        if self._socket is not None:
            try:
                self._socket.sendto(state.encode(), self._address)
            except OSError:  # a watchdog that does not hear us acts on that
                return

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()
