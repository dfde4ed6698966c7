"""What sites have promised to instances: sums that follow as instances come and go.

So nobody adds all up to place one. Whoever places makes the sums anew now and then from what is stored, and so makes
good what was missed in between.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable, Mapping
from typing import NamedTuple

from ..domain.records import Record
from ..runtimes.base import Capacity


class Promised(NamedTuple):
    """At one site."""

    cpu: float = 0.0
    memory_mb: int = 0
    gpu: int = 0
    instances: int = 0

    @property
    def capacity(self) -> Capacity:
        return Capacity(self.cpu, self.memory_mb, self.gpu)


NOTHING = Promised()
Sums = Mapping[str, Promised]
"""By site; where nothing is promised there may be none."""


class Promises:
    """Of all sites, at each to which instances. Safe from any thread."""

    def __init__(self, records: Iterable[Record] = ()) -> None:
        """``records``: all that has not ended; those without a site are promised nothing."""
        self._lock = threading.Lock()
        self._of: dict[str, tuple[str, Promised]] = {}
        self._sums: dict[str, Promised] = {}
        for record in records:
            self.add(record)

    def add(self, record: Record) -> None:
        """It has its site now."""
        if record.site is None:
            return
        with self._lock:
            self._subtract(self._sums, self._of.pop(record.id, None))
            given = record.site, _needs(record)
            self._of[record.id] = given
            self._sums[record.site] = _sum(self._sums.get(record.site, NOTHING), given[1], 1)

    def remove(self, record: Record) -> None:
        """It has none any more."""
        with self._lock:
            self._subtract(self._sums, self._of.pop(record.id, None))

    def sums(self, without: Iterable[str] = ()) -> Sums:
        """As they are now, or as they would be without some instances."""
        with self._lock:
            sums = dict(self._sums)
            for instance in without:
                self._subtract(sums, self._of.get(instance))
        return sums

    @staticmethod
    def _subtract(sums: dict[str, Promised], given: tuple[str, Promised] | None) -> None:
        if given is not None:
            site, needs = given
            sums[site] = _sum(sums[site], needs, -1)


def _needs(record: Record) -> Promised:
    held = record.holds
    return Promised(held.cpu, held.memory_mb, record.spec.needs.gpu, 1)


def _sum(some: Promised, more: Promised, sign: int) -> Promised:
    return Promised(
        some.cpu + sign * more.cpu,
        some.memory_mb + sign * more.memory_mb,
        some.gpu + sign * more.gpu,
        some.instances + sign * more.instances,
    )
