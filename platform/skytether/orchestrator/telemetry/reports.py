"""What robots report with their renewals, on its way into the database.

A renewal costs one statement; the reports of a moment are written together. A report holds all that its robot has
counted, so one that is lost with a program that is killed is made good by the next.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import islice
from typing import Any

from skytether.api.report_metrics import Counts, Owner

from ..domain.records import Record
from ..store.store import Store

PERIOD = 1.0
"""Seconds that a report waits at most."""
_TOGETHER = 100
"""Instances whose reports are written in one transaction: others want to write too."""


@dataclass(slots=True)
class _Heard:
    owner: Owner
    at: float
    report: Mapping[str, Any]
    counted: list[tuple[str, Counts]]


class Reports:
    """Keeps reports for a moment. Safe from any thread."""

    def __init__(self, store: Store, beyond: Callable[[Mapping[str, int]], None] = lambda _: None) -> None:
        """``beyond``: told how many names of a robot were too many, by robot."""
        self._store = store
        self._beyond = beyond
        self._heard: dict[str, _Heard] = {}
        """By instance."""
        self._taking = threading.Lock()
        self._writing = threading.Lock()

    def add_report(self, record: Record, now: float, report: Mapping[str, Any], life: str, counts: Counts) -> None:
        """Hear a robot.

        Args:
            record: The instance that it tells of.
            now: Seconds since the epoch.
            report: Instead of the one before.
            life: Whose counting it is.
            counts: What is counted by now: see `accounts.CounterTotals.merge`.
        """
        with self._taking:
            before = self._heard.get(record.id)
            counted = before.counted if before else []
            counted.append((life, counts))
            self._heard[record.id] = _Heard((record.robot, record.service), now, report, counted)

    def write(self) -> None:
        """Bring everything that was taken into the database; if that fails, it is kept for the next time."""
        with self._writing:
            with self._taking:
                heard, self._heard = self._heard, {}
            try:
                while heard:
                    self._save(dict(islice(heard.items(), _TOGETHER)))
                    for instance in list(islice(heard, _TOGETHER)):
                        del heard[instance]
            finally:
                with self._taking:
                    for instance, one in heard.items():
                        newer = self._heard.setdefault(instance, one)
                        if newer is not one:
                            newer.counted[:0] = one.counted

    def _save(self, heard: Mapping[str, _Heard]) -> None:
        counted: dict[Owner, list[tuple[str, Counts]]] = {}
        for one in heard.values():
            counted.setdefault(one.owner, []).extend(one.counted)
        beyond = self._store.keep_robot_reports(
            {instance: (one.at, one.report) for instance, one in heard.items()}, counted
        )
        if beyond:
            self._beyond(beyond)
