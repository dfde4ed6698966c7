"""Log lines of the agent wait in a bounded queue for a thread of their own: nothing else ever waits for a log.

A pipe that nobody reads, a terminal that was stopped, a hanging disk: whoever writes a line to one of them waits. A
control loop that says why it hands over would wait in the middle of the hand-over.
"""

from __future__ import annotations

import logging
import queue
import threading
from contextlib import suppress
from logging.handlers import QueueHandler

MOST_LINES = 1000
"""Lines that wait at most, some hundred KiB; further ones are dropped and counted. An agent says few a minute."""
DRAIN_S = 1.0
"""At the end, for lines that still wait: a log that is not read by then is not read."""
_NAME = "skytether"
"""All loggers of the package are below this one."""


class LogQueue:
    """Puts itself between the loggers of the package and the handlers of the program that it runs in.

    Handlers that are attached to a single logger further below are left as they are: these may wait.
    """

    def __init__(self, most: int = MOST_LINES, drain_s: float = DRAIN_S) -> None:
        self._lines: queue.Queue[logging.LogRecord | None] = queue.Queue(most)
        self._drain_s = drain_s
        self._logger = logging.getLogger(_NAME)
        self._lock = threading.Lock()
        self._users = 0
        self._handler = _Into(self._lines)
        self._before: tuple[list[logging.Handler], bool] = ([], True)
        self._thread: threading.Thread | None = None
        self._leave = threading.Event()

    @property
    def dropped(self) -> int:
        """Lines that found the queue full, since the program began."""
        return self._handler.dropped

    def use(self) -> None:
        """From here on no line is waited for; `done` ends it. Several may use it at the same time."""
        with self._lock:
            self._users += 1
            if self._users > 1:
                return
            logger = self._logger
            self._before = (logger.handlers[:], logger.propagate)
            logger.handlers[:] = [self._handler]
            logger.propagate = False
            self._leave = threading.Event()
            self._thread = threading.Thread(
                target=self._run, args=(*self._before, self._leave), name="log", daemon=True
            )
            self._thread.start()

    def done(self) -> None:
        """The lines that wait are written, if somebody reads; then all is as it was before `use`."""
        with self._lock:
            self._users -= 1
            if self._users:
                return
            self._logger.handlers[:], self._logger.propagate = self._before
            thread, self._thread = self._thread, None
            leave = self._leave
        with suppress(queue.Full):  # nobody has read for long: the thread is left behind, it ends with the program
            self._lines.put(None, timeout=self._drain_s)
        if thread is not None:
            thread.join(self._drain_s)
        leave.set()

    def _run(self, handlers: list[logging.Handler], propagate: bool, leave: threading.Event) -> None:
        told = self.dropped
        while not leave.is_set():
            record = self._lines.get()
            if record is not None:
                _handle(record, handlers, propagate)
            if (dropped := self.dropped) != told and (record is None or self._lines.empty()):
                told, lines = dropped, dropped - told
                text = f"{lines} lines of the log were dropped: nobody read them"
                told_of = logging.LogRecord(__name__, logging.WARNING, __file__, 0, text, None, None)
                _handle(told_of, handlers, propagate)
            if record is None:
                return


class _Into(QueueHandler):
    def __init__(self, lines: queue.Queue[logging.LogRecord | None]) -> None:
        super().__init__(lines)
        self.dropped = 0

    def enqueue(self, record: logging.LogRecord) -> None:
        try:
            self.queue.put_nowait(record)
        except queue.Full:
            self.dropped += 1


def _handle(record: logging.LogRecord, handlers: list[logging.Handler], propagate: bool) -> None:
    with suppress(Exception):  # a handler that fails must not end the log
        for handler in handlers:
            if record.levelno >= handler.level:
                handler.handle(record)
        if propagate:
            logging.getLogger().handle(record)


log_queue = LogQueue()
"""The program's; loggers are the program's too."""
