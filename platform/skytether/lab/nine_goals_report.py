"""Many trials of `nine_goals` in a few numbers, beside those of the thesis (Mello, section 5.6.3)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from statistics import fmean, stdev
from types import MappingProxyType
from typing import Any

from .nine_goals import TrialResult

FIGURES = (
    "start_s",
    "time_s",
    "distance_m",
    "first_leg_m",
    "mean_speed_m_s",
    "rtt_ms",
    "robot_cpu",
    "service_cpu",
    "service_memory_mb",
)
"""Of each trial: fields of `TrialResult`."""
Pair = tuple[float, float]
"""Mean and standard deviation."""
THESIS: Mapping[str, Mapping[str, Pair]] = MappingProxyType(
    {
        "embedded": {
            "time_s": (128.7, 13.1),
            "distance_m": (43.4, 4.0),
            "first_leg_m": (6.5, 3.5),
            "mean_speed_m_s": (0.33, 1.0),
        },
        "edge": {
            "time_s": (100.6, 3.6),
            "distance_m": (40.7, 0.3),
            "first_leg_m": (3.8, 0.2),
            "mean_speed_m_s": (0.39, 0.9),
            "rtt_ms": (28.7, 20.9),
        },
        "commercial": {
            "time_s": (109.8, 9.0),
            "distance_m": (41.7, 1.0),
            "first_leg_m": (4.2, 1.0),
            "mean_speed_m_s": (0.38, 1.0),
            "rtt_ms": (152.2, 24.7),
        },
        "private": {
            "time_s": (112.1, 8.1),
            "distance_m": (41.8, 0.8),
            "first_leg_m": (4.4, 1.0),
            "mean_speed_m_s": (0.36, 0.9),
            "rtt_ms": (196.2, 24.1),
        },
    }
)
"""By scenario, five trials each; the deviation of the speed is that within a trial."""


def summary(results: Sequence[TrialResult]) -> list[dict[str, Any]]:
    """Each scenario in one row, in the order in which they were run.

    Returns:
        How many trials, how many of them completed, and of each of `FIGURES` mean and standard deviation over the
        completed ones; None where there are too few for it.
    """
    rows = []
    for name in dict.fromkeys(result.scenario for result in results):
        mine = [result for result in results if result.scenario == name]
        good = [result for result in mine if result.completed]
        row: dict[str, Any] = {"scenario": name, "trials": len(mine), "completed": len(good)}
        row["contacts"] = sum(result.contacts for result in mine)
        for figure in FIGURES:
            values = [value for one in good if not math.isnan(value := getattr(one, figure))]
            row[figure] = round(fmean(values), 3) if values else None
            row[f"{figure}_std"] = round(stdev(values), 3) if len(values) > 1 else None
        rows.append(row)
    return rows


def compare_times(results: Sequence[TrialResult], baseline: str) -> list[dict[str, Any]]:
    """Student's t-test of the completion times against those of one scenario (thesis, section 4.3.5).

    Returns:
        For each other scenario with two completed trials at least: ``t``, ``p`` of two sides, ``slower``: how much
        longer its mean time is, as a share.
    """
    from scipy.stats import ttest_ind  # of the extra `navigation`, which the service itself needs

    times: dict[str, list[float]] = {}
    for result in results:
        if result.completed:
            times.setdefault(result.scenario, []).append(result.time_s)
    base = times.get(baseline, [])
    rows = []
    for name, values in times.items():
        if name != baseline and min(len(base), len(values)) > 1:
            found = ttest_ind(values, base)
            slower = fmean(values) / fmean(base) - 1
            rows.append(
                {
                    "scenario": name,
                    "against": baseline,
                    "t": round(float(found.statistic), 3),
                    "p": round(float(found.pvalue), 4),
                    "slower": round(slower, 4),
                }
            )
    return rows
