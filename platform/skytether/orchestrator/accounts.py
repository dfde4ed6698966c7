"""What was counted of one robot and service, over all programs and runs that counted it. Pure.

Each of them counts from zero; an account keeps the highest value of each counter of each life, and its sum over lives
is what is exported. So a report that comes twice, late or after a newer one changes nothing, a robot or service that is
restarted adds to what was counted before, and no sum goes down (a grow-only counter: Shapiro et al., INRIA 2011).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from functools import reduce
from math import inf
from typing import Any

from skytether.api.report_metrics import Counts
from skytether.api.rest import Report

from .records import Record
from .runtimes.base import Observation

_MOST_LIVES = {"robot": 8, "run": 64, "instance": 64}
"""Of each kind that can still count; what the one that was longest silent had counted is only a sum from then on."""
_MOST_SERIES = 1024
"""Of each metric, so that no robot can blow up their number in the course of time (128 topics of 8 outcomes)."""


class Account:
    """The counters of one robot and service."""

    def __init__(self, kept: Mapping[str, Any] | None = None) -> None:
        """``kept``: what ``document`` gave."""
        kept = kept or {}
        self._past: dict[tuple[str, ...], float] = _counts(kept.get("past", ()))
        self._lives = {life: _counts(rows) for life, rows in kept.get("lives", ())}
        """The one that counted last is the last."""

    def document(self) -> dict[str, Any]:
        """As JSON."""
        lives = [[life, _rows(counts)] for life, counts in self._lives.items()]
        return {"past": _rows(self._past), "lives": lives}

    def merge(self, life: str, counts: Counts) -> None:
        """Take what somebody has counted by now.

        Args:
            life: Whose counting it is, as ``of_run``, ``of_instance`` and ``of_robot`` name it; it began at zero.
            counts: By metric and labels.
        """
        known = self._lives.pop(life, {})
        if not counts.keys() <= known.keys():
            counts = self._with_room(counts, known)
        for key, value in counts.items():
            if value > known.get(key, -inf):
                known[key] = value
        self._lives[life] = known
        kind = life.partition(":")[0]
        same = [other for other in self._lives if other.partition(":")[0] == kind]
        for oldest in same[: -_MOST_LIVES[kind]]:
            self._past = _added(self._past, self._lives.pop(oldest))

    def _with_room(self, counts: Counts, known: Counts) -> Counts:
        """Without new ones of a metric that has too many."""
        series = self.sums().keys() | known.keys()
        number = Counter(key[0] for key in series)
        room = {}
        for key, value in counts.items():
            if key not in series:
                if number[key[0]] >= _MOST_SERIES:
                    continue
                number[key[0]] += 1
            room[key] = value
        return room

    def sums(self) -> dict[tuple[str, ...], float]:
        """By metric and labels."""
        return reduce(_added, self._lives.values(), self._past)


def of_run(record: Record, seen: Observation) -> tuple[str, Counts]:
    """The life and the counters of one run of an instance."""
    site = record.site or ""
    used = {
        "instance_cpu_seconds": seen.cpu_s,
        "instance_network_receive_bytes": seen.received_bytes,
        "instance_network_transmit_bytes": seen.sent_bytes,
    }
    return f"run:{record.id}:{seen.attempt}", {(name, site): n for name, n in used.items() if n is not None}


def of_instance(record: Record) -> tuple[str, Counts]:
    """The life and the counters of an instance over its runs."""
    return f"instance:{record.id}", {("instance_restarts", record.site or ""): record.restarts}


def of_robot(report: Report) -> str:
    """The life of what a robot reports."""
    return f"robot:{report.life}"


def _added(one: dict[tuple[str, ...], float], other: dict[tuple[str, ...], float]) -> dict[tuple[str, ...], float]:
    """The sums of both; less work where one of them has few."""
    small, large = sorted((one, other), key=len)
    sums = dict(large)
    for key, value in small.items():
        sums[key] = sums.get(key, 0) + value
    return sums


def _counts(rows: Iterable[tuple[list[str], float]]) -> dict[tuple[str, ...], float]:
    return {tuple(key): value for key, value in rows}


def _rows(counts: Counts) -> list[tuple[list[str], float]]:
    return [(list(key), value) for key, value in counts.items()]
