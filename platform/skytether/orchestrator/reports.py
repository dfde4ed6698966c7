"""What robots report with their renewals, on its way into the database.

A renewal costs one statement; the reports of a moment are written together. A report holds all that its robot has
counted, so one that is lost with a program that is killed is made good by the next.
"""

from __future__ import annotations

import threading
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from skytether.api.report_metrics import Counts, Owner

from .records import Record
from .store import Store

PERIOD = 1.0
"""Seconds that a report waits at most."""


@dataclass(slots=True)
class _Heard:
    reports: dict[str, tuple[float, Mapping[str, Any]]] = field(default_factory=dict)
    counted: dict[Owner, list[tuple[str, Counts]]] = field(default_factory=lambda: defaultdict(list))


class Reports:
    """Keeps reports for a moment. Safe from any thread."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._heard = _Heard()
        self._taking = threading.Lock()
        self._writing = threading.Lock()

    def take(self, record: Record, now: float, report: Mapping[str, Any], life: str, counts: Counts) -> None:
        """Hear a robot.

        Args:
            record: The instance that it tells of.
            now: Seconds since the epoch.
            report: Instead of the one before.
            life: Whose counting it is.
            counts: What is counted by now: see `accounts.Account.merge`.
        """
        with self._taking:
            self._heard.reports[record.id] = (now, report)
            self._heard.counted[record.robot, record.service].append((life, counts))

    def write(self) -> None:
        """Bring everything that was taken into the database; if that fails, it is kept for the next time."""
        with self._writing:
            with self._taking:
                heard, self._heard = self._heard, _Heard()
            if not heard.reports:
                return
            try:
                self._store.hear(heard.reports, heard.counted)
            except BaseException:
                with self._taking:
                    self._heard.reports = heard.reports | self._heard.reports
                    for owner, counted in heard.counted.items():
                        self._heard.counted[owner][:0] = counted
                raise
