"""What a node tells people by its graph, as rospy and roscpp do: its log on /rosout, and services for the log's levels.

The services are ``~get_loggers`` and ``~set_logger_level``, which ``rosconsole`` and rqt_logger_level ask.
"""

from __future__ import annotations

import logging
import struct
import time
from collections.abc import Callable
from types import TracebackType

from skytether.messages import encode_plain, hash_of

from ..log_tap import LogTap
from .node import Node
from .services import ServiceServer, ServiceType

_log = logging.getLogger(__name__)

ROSOUT = "/rosout"
_LOG = "rosgraph_msgs/msg/Log"
_QUEUE = 100
"""As rospy has it."""
_HOLD_S = 10.0
"""For rosout to connect, after a start: what is said first says most."""
_GET = ServiceType("roscpp/GetLoggers", "32e97e85527d4678a8f9279894bb64b0")
_SET = ServiceType("roscpp/SetLoggerLevel", "51da076440d78ca1684d36c868df61ea")
_LEVELS = {
    "debug": logging.DEBUG, "info": logging.INFO, "warn": logging.WARNING, "error": logging.ERROR,
    "fatal": logging.CRITICAL,
}  # fmt: skip
"""Names of ROS; in its messages the levels are powers of two in this order."""


class Console:
    """A context manager: for as long as it lasts, what the loggers say is on /rosout too.

    Args:
        node: Started; its name is the message's.
        root: See `LogTap`.
        clock: Unix time in seconds.
    """

    def __init__(self, node: Node, root: str = "skytether", clock: Callable[[], float] = time.time) -> None:
        self._node = node
        self._publication = node.advertise(ROSOUT, _LOG, hash_of(_LOG, "ros1"), queue=_QUEUE, hold_s=_HOLD_S)
        self._tap = LogTap(root, self._publish)
        self._root = self._tap.root
        self._clock = clock
        self._sequence = 0
        self._servers: list[ServiceServer] = []

    def __enter__(self) -> Console:
        self._tap.__enter__()
        for name, kind, handler in (("get_loggers", _GET, self._loggers), ("set_logger_level", _SET, self._set_level)):
            self._servers.append(self._node.serve(f"{self._node.name}/{name}", kind, handler))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._tap.__exit__(kind, error, trace)
        for server in self._servers:
            self._node.unserve(server)
        self._node.unadvertise(self._publication)

    def _publish(self, record: logging.LogRecord, text: str) -> None:
        self._sequence += 1
        seconds, rest = divmod(self._clock(), 1)
        stamp = {"sec": int(seconds), "nanosec": int(rest * 1e9)}
        values = {
            "header": {"seq": self._sequence, "stamp": stamp},
            "level": _number(record.levelno),
            "name": self._node.name,
            "msg": text,
            "file": record.pathname,
            "function": record.funcName or "",
            "line": record.lineno,
            "topics": [topic for topic, _ in self._node.publications()],
        }
        self._publication.publish(encode_plain(_LOG, values, "ros1"))

    def _names(self) -> list[str]:
        below = self._root.name + "."
        found = [n for n, one in logging.root.manager.loggerDict.items() if isinstance(one, logging.Logger)]
        return [self._root.name, *sorted(name for name in found if name.startswith(below))]

    def _loggers(self, _: bytes) -> bytes:
        rows = [(name, _word(logging.getLogger(name).getEffectiveLevel())) for name in self._names()]
        return struct.pack("<I", len(rows)) + b"".join(_text(name) + _text(level) for name, level in rows)

    def _set_level(self, request: bytes) -> bytes:
        name, level = _texts(request)
        if level.lower() not in _LEVELS or name not in self._names():
            raise ValueError(f"there is no logger {name} with a level {level}; levels are {', '.join(_LEVELS)}")
        logging.getLogger(name).setLevel(_LEVELS[level.lower()])
        return b""


def _word(level: int) -> str:
    return [name for name, number in _LEVELS.items() if number <= max(level, logging.DEBUG)][-1]


def _number(level: int) -> int:
    return int(1 << list(_LEVELS).index(_word(level)))


def _text(text: str) -> bytes:
    data = text.encode()
    return struct.pack("<I", len(data)) + data


def _texts(data: bytes) -> tuple[str, str]:
    """Two texts, and nothing else.

    Raises:
        ValueError: It is not that.
    """
    found = []
    at = 0
    for _ in range(2):
        if at + 4 > len(data):
            raise ValueError("the request ends within a text")
        end = at + 4 + struct.unpack_from("<I", data, at)[0]
        found.append(data[at + 4 : end].decode(errors="replace"))
        at = end
    if at != len(data):
        raise ValueError("the request is no logger and level")
    return found[0], found[1]
