"""What the agent's loggers say, for a graph's log: `/rosout` of ROS 1 and ROS 2."""

from __future__ import annotations

import logging
from collections.abc import Callable
from types import TracebackType
from typing import Self


class LogTap(logging.Handler):
    """A context manager: for as long as it lasts, a function gets what the loggers say.

    Args:
        root: Name of the logger that all others are below. It says from ``info`` on what it said from ``warn`` on;
            what other handlers print stays the same.
        say: Given the record and its text; returns at once.
    """

    def __init__(self, root: str, say: Callable[[logging.LogRecord, str], object]) -> None:
        super().__init__()
        self.root = logging.getLogger(root)
        """All others are below."""
        self._on_record = say
        self._level_before = self.root.level

    def __enter__(self) -> Self:
        top = logging.getLogger()
        if not top.handlers and logging.lastResort is not None:
            top.addHandler(logging.lastResort)  # what prints warnings as long as nobody handles anything
        if self.root.level == logging.NOTSET:
            self.root.setLevel(logging.INFO)
        self.root.addHandler(self)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.root.removeHandler(self)
        self.root.setLevel(self._level_before)

    def emit(self, record: logging.LogRecord) -> None:
        """Handler: give it on."""
        try:
            self._on_record(record, self.format(record))
        except Exception:
            self.handleError(record)
