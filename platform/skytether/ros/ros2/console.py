"""The agent's log on /rosout, where any node of ROS 2 has its own."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from types import TracebackType

from skytether.messages import encode_plain, hash_of

from ..log_tap import LogTap
from .dialect import Endpoint, Kind
from .qos import Qos
from .seam import GraphNode

ROSOUT = "/rosout"
LOG = "rcl_interfaces/msg/Log"
KEPT = 100
"""Messages that wait for the graph, and that a newcomer gets."""
MAX_TEXT = 8192
"""Characters of a message."""
LOOK_S = 0.5
"""Between two looks at the level of our node's logger, and whether the graph is joined."""
_LEVELS = (logging.DEBUG, logging.INFO, logging.WARNING, logging.ERROR, logging.CRITICAL)
"""ROS 2 has the same numbers."""


class Console:
    """A context manager: for as long as it lasts, what the loggers say is on /rosout too.

    The level of our node's logger (``--log-level``, its service ``set_logger_levels``) becomes that of the loggers.
    Nobody who says something waits for the graph: a thread of its own publishes, and what is too much loses the oldest.

    Args:
        node: Started.
        name: Of the node, absolute.
        root: See `LogTap`.
        clock: Unix time in seconds.
    """

    def __init__(
        self, node: GraphNode, name: str, root: str = "skytether", clock: Callable[[], float] = time.time
    ) -> None:
        self._node = node
        self._name = name.strip("/").replace("/", ".")
        self._clock = clock
        self._tap = LogTap(root, self._enqueue)
        self._level = logging.INFO
        qos = Qos(transient_local=True, depth=KEPT)
        self._publication = node.publish(Endpoint(Kind.PUBLISHER, ROSOUT, LOG, hash_of(LOG, "cdr"), qos))
        self._waiting: deque[bytes] = deque(maxlen=KEPT)
        self._changed = threading.Event()
        self._ended = False
        self._thread = threading.Thread(target=self._run, name="ros2-rosout", daemon=True)

    def __enter__(self) -> Console:
        self._thread.start()
        self._tap.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._tap.__exit__(kind, error, trace)
        self._ended = True
        self._changed.set()
        self._thread.join()  # the publication ends with the node: what still waits in it would be lost

    def _enqueue(self, record: logging.LogRecord, text: str) -> None:
        if record.thread == self._thread.ident:
            return  # of publishing itself: that would go round and round
        seconds, rest = divmod(self._clock(), 1)
        values = {
            "stamp": {"sec": int(seconds), "nanosec": int(rest * 1e9)},
            "level": max((level for level in _LEVELS if level <= record.levelno), default=logging.DEBUG),
            "name": self._name,
            "msg": text if len(text) <= MAX_TEXT else f"{text[: MAX_TEXT - 1]}…",
            "file": record.pathname,
            "function": record.funcName or "",
            "line": record.lineno,
        }
        self._waiting.append(encode_plain(LOG, values))
        self._changed.set()

    def _run(self) -> None:
        """Thread that publishes, and follows the level."""
        while not self._ended:
            self._changed.wait(LOOK_S)
            self._changed.clear()
            if self._node.log_level != self._level:
                self._level = self._node.log_level
                self._tap.root.setLevel(self._level)
            while self._waiting and self._node.wait_until_joined(0.0):
                self._publication.put(self._waiting.popleft())
