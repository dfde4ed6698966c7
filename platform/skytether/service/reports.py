"""What a service reports of itself: kept in a file beside its ready file, from where the orchestrator takes it."""

from __future__ import annotations

import logging
import os
import threading
from collections import deque
from pathlib import Path

from skytether.api.service_report import MOST_REPORTS, ServiceReport, is_code, write_reports

log = logging.getLogger(__name__)


class Reports:
    """The newest reports of one run, and the file that holds them."""

    def __init__(self) -> None:
        self.path: Path | None = None
        """The file; None: there is none, as in tests."""
        self.recent: deque[ServiceReport] = deque(maxlen=MOST_REPORTS)
        self._step_s: float | None = None
        self._lock = threading.Lock()

    def add(self, code: str, message: str) -> None:
        """Report something; what was reported last, word for word, is not reported again.

        Raises:
            ValueError: The code is none.
        """
        if not is_code(code):
            raise ValueError(f"a report's code has small letters, digits and underscores only, not {code!r}")
        with self._lock:
            last = self.recent[-1] if self.recent else ServiceReport(0, "", "")
            if (last.code, last.message) == (code, message):
                return
            self.recent.append(ServiceReport(last.number + 1, code, message))
            if self.path is not None:
                self._write(self.path)

    def report_step_time(self, step_s: float) -> None:
        """Say how long steps take; from any thread."""
        with self._lock:
            self._step_s = step_s
            if self.path is not None:
                self._write(self.path)

    def _write(self, path: Path) -> None:
        """In one piece. A service does its work on a full disk, too."""
        draft = path.with_name(f".{path.name}.{os.getpid()}")
        try:
            draft.write_bytes(write_reports(self.recent, self._step_s))
            draft.replace(path)
        except OSError as error:
            log.warning("a report cannot be written: %s", error)
