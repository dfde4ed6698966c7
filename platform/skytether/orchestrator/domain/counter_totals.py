"""What was counted of one robot and service, over all programs and runs that counted it. Pure.

Each of them counts from zero; a total keeps the highest value of each counter of each life, and its sum over lives
is what is exported. So a report that comes twice, late or after a newer one changes nothing, a robot or service that is
restarted adds to what was counted before, and no sum goes down (a grow-only counter: Shapiro et al., INRIA 2011).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from functools import partial, reduce
from math import inf
from typing import Any

from skytether.api.report_metrics import Counts, Owner
from skytether.api.rest import Report

from ..runtimes.base import Observation
from .records import Record

_MOST_LIVES = {"robot": 8, "run": 64, "instance": 64}
"""Of each kind that can still count; what the one that was longest silent had counted is only a sum from then on."""
MOST_NAMES = 256
"""Of one robot, unless the operator says otherwise."""


_OF_REASONS = ("fallback_transitions", "control_objections")
Name = tuple[str, ...]


class CounterTotals:
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

    def merge(self, life: str, counts: Counts, room: Callable[[], int] = lambda: MOST_NAMES) -> int:
        """Take what somebody has counted by now.

        Args:
            life: Whose counting it is, as ``of_run``, ``of_instance`` and ``of_robot`` name it; it began at zero.
            counts: By metric and labels.
            room: How many names a robot may have made up in here; asked only if there is a new one.

        Returns:
            How many names were beyond that: their counters are dropped.
        """
        known = self._lives.pop(life, {})
        beyond: set[Name] = set()
        if not counts.keys() <= known.keys():
            counts, beyond = self._with_room(counts, known, room)
        for key, value in counts.items():
            if value > known.get(key, -inf):
                known[key] = value
        self._lives[life] = known
        kind = life.partition(":")[0]
        same = [other for other in self._lives if other.partition(":")[0] == kind]
        for oldest in same[: -_MOST_LIVES[kind]]:
            self._past = _added(self._past, self._lives.pop(oldest))
        return len(beyond)

    def _with_room(self, counts: Counts, known: Counts, room: Callable[[], int]) -> tuple[Counts, set[Name]]:
        """Without those under new names for which there is no room, and these names."""
        names = self.names() | _names_of(known)
        beyond: set[Name] = set()
        fitting = {}
        most = -1
        for key, value in counts.items():
            name = name_in(key)
            if name is not None and name not in names:
                if most < 0:
                    most = max(0, room())
                if len(names) >= most:
                    beyond.add(name)
                    continue
                names.add(name)
            fitting[key] = value
        return fitting, beyond

    def names(self) -> set[Name]:
        """All that its robot made up, ever since."""
        return _names_of(self._past).union(*map(_names_of, self._lives.values()))

    def sums(self) -> dict[tuple[str, ...], float]:
        """By metric and labels."""
        return reduce(_added, self._lives.values(), self._past)


def merge(
    kept: Mapping[Owner, Mapping[str, Any]], counted: Mapping[Owner, Iterable[tuple[str, Counts]]], names: int
) -> tuple[dict[Owner, CounterTotals], Counter[str]]:
    """Take what robots have counted by now.

    Args:
        kept: The documents of all accounts of these robots.
        counted: By robot and service: lives and what each has counted.
        names: That one robot may make up, whatever the service.

    Returns:
        The accounts of ``counted``, and by robot how many names were beyond that.
    """
    merged = {owner: CounterTotals(kept[owner]) for owner in counted}
    beyond: Counter[str] = Counter()

    def room(owner: Owner) -> int:
        others = [other for other in kept if other[0] == owner[0] and other != owner]
        return names - sum(len((merged.get(other) or CounterTotals(kept[other])).names()) for other in others)

    for owner, account in merged.items():
        for life, counts in counted[owner]:
            beyond[owner[0]] += account.merge(life, counts, partial(room, owner))
    return merged, +beyond


def name_in(key: tuple[str, ...]) -> Name | None:
    """What a robot made up of a counter's metric and labels; None: nothing.

    Each name is worth at most a dozen series: a topic with its direction, or a reason.
    """
    metric, *labels = key
    if metric.startswith("topic_"):
        return ("topic", *labels[:3])
    return key if metric in _OF_REASONS else None


def _names_of(counts: Iterable[tuple[str, ...]]) -> set[Name]:
    return {name for key in counts if (name := name_in(key)) is not None}


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
