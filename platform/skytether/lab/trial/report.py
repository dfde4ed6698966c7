"""Many trials in a few numbers: each scenario, each of its topics, each of its devices in one row."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from statistics import fmean, stdev
from typing import Any

from .results import TrialResult

Pair = tuple[float, float]
"""Mean and standard deviation."""
Ideal = Callable[[str, str], float | None]
"""Of scenario and topic the period with which its messages are sent [ms]."""


def summary(results: Sequence[TrialResult], figures: Sequence[str]) -> list[dict[str, Any]]:
    """Each scenario in one row, in the order in which they were run.

    Args:
        results: Of one experiment.
        figures: Fields of them, which are numbers.

    Returns:
        How many trials, how many of them completed, and of each figure mean and standard deviation over the completed
        ones; None where there are too few for it.
    """
    rows = []
    for name in dict.fromkeys(result.scenario for result in results):
        mine = [result for result in results if result.scenario == name]
        good = [result for result in mine if result.completed]
        row: dict[str, Any] = {"scenario": name, "trials": len(mine), "completed": len(good)}
        row["contacts"] = sum(result.contacts for result in mine)
        for figure in figures:
            values = [value for one in good if not math.isnan(value := getattr(one, figure))]
            row[figure] = round(fmean(values), 3) if values else None
            row[f"{figure}_std"] = round(stdev(values), 3) if len(values) > 1 else None
        rows.append(row)
    return rows


def topics(results: Sequence[TrialResult], names: Sequence[str], ideal_ms: Ideal) -> list[dict[str, Any]]:
    """Each topic of each scenario in one row: mean and standard deviation over the completed trials.

    Returns:
        Of ``lost``, ``delay_ms``, ``jitter_ms``, ``period_ms`` and ``period_p99_ms``, as in `TopicRow`
        and ``ideal_ms``.
    """
    rows = []
    for name in dict.fromkeys(result.scenario for result in results):
        good = [result for result in results if result.scenario == name and result.completed]
        for topic in names:
            mine = [row for result in good for row in result.topics if row.topic == topic]
            if not mine:
                continue
            line: dict[str, Any] = {"scenario": name, "topic": topic, "ideal_ms": ideal_ms(name, topic)}
            for figure in ("lost", "delay_ms", "jitter_ms", "period_ms", "period_p99_ms"):
                values = [value for row in mine if not math.isnan(value := getattr(row, figure))]
                line[figure] = round(fmean(values), 5) if values else None
                line[f"{figure}_std"] = round(stdev(values), 5) if len(values) > 1 else None
            rows.append(line)
    return rows


def devices(row: Mapping[str, Any], *, on_robot: bool) -> list[tuple[str, Pair, Pair]]:
    """Of one row of `summary` each device: its processors in use [% of one], and memory [MB].

    Where the service runs on the robot, both are one device. NaN where there are too few trials.
    """
    cpu = {side: _pair_of(row, f"{side}_cpu", 100) for side in ("robot", "service")}
    memory = {side: _pair_of(row, f"{side}_memory_mb") for side in ("robot", "service")}
    if not on_robot:
        return [(side, cpu[side], memory[side]) for side in ("robot", "service")]
    both = [
        (parts["robot"][0] + parts["service"][0], math.hypot(parts["robot"][1], parts["service"][1]))
        for parts in (cpu, memory)
    ]
    return [("robot", both[0], both[1])]


def _pair_of(row: Mapping[str, Any], name: str, factor: float = 1.0) -> Pair:
    mean, deviation = row[name], row[f"{name}_std"]
    return tuple(math.nan if value is None else factor * value for value in (mean, deviation))  # type: ignore[return-value]
