"""What services report becomes events of their instances: each report once, and of each instance a few a minute.

Whoever leads does it, with what the runtimes read. Up to which report that was done is in the instance's record, so the
next leader goes on from there.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable, Mapping

from skytether.api.rest import State
from skytether.api.service_report import ServiceReport

from ..domain.records import Record
from ..runtimes.base import Observation
from ..store.store import Store

MOST = 6
"""Events of one instance within `PERIOD`; of more reports the newest are told, once there is room."""
PERIOD = 60.0
"""Seconds."""
_RUNS = (State.STARTING, State.RUNNING, State.STOPPING)


class ServiceEvents:
    """Safe from any thread, as long as each instance is of one."""

    def __init__(self, store: Store, steady: Callable[[], float]) -> None:
        """``steady``: seconds of a clock that nobody sets."""
        self._store = store
        self._steady = steady
        self._lock = threading.Lock()
        self._told: dict[str, deque[float]] = {}
        """By instance, when its last events were told; a new leader begins anew."""

    def keep(self, records: Iterable[Record], seen: Mapping[str, Observation], now: float) -> list[Record]:
        """Make events of what is new.

        Args:
            records: As they were read before the look.
            seen: What the runtime reports, by instance.
            now: Seconds since the epoch.

        Returns:
            The records as they are now.
        """
        return [self._keep(record, seen.get(record.id), now) for record in records]

    def _keep(self, record: Record, seen: Observation | None, now: float) -> Record:
        if seen is None or seen.attempt != record.attempt or record.state not in _RUNS:
            return record
        new = [report for report in seen.reports if report.number > record.said]
        room = self._room(record.id) if new else 0
        if not room:
            return record
        told = new[-room:]
        after = self._store.add_service_reports(record, now, told)
        if after is None:
            return record  # changed meanwhile: the next pass tells it
        self._count(record.id, told)
        return after

    def _room(self, instance: str) -> int:
        since = self._steady() - PERIOD
        with self._lock:
            self._told = {i: times for i, times in self._told.items() if times[-1] > since}
            return MOST - sum(at > since for at in self._told.get(instance, ()))

    def _count(self, instance: str, told: Iterable[ServiceReport]) -> None:
        now = self._steady()
        with self._lock:
            self._told.setdefault(instance, deque(maxlen=MOST)).extend(now for _ in told)
