"""Many trials of `nine_goals` in a few numbers, beside those of the thesis (Mello, sections 4.3.5 and 5.6.3)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import fmean
from types import MappingProxyType
from typing import Any

from .nine_goals_result import NineGoalsResult
from .trial import report
from .trial.report import Pair

FIGURES = (
    "start_s",
    "time_s",
    "distance_m",
    "first_leg_m",
    "mean_speed_m_s",
    "rtt_ms",
    "robot_cpu",
    "robot_memory_mb",
    "service_cpu",
    "service_memory_mb",
)
"""Of each trial: fields of `NineGoalsResult`."""
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
THESIS_TRIALS = 5
DEVICES: Mapping[str, Sequence[tuple[str, Pair, Pair]]] = MappingProxyType(
    {
        "embedded": [("robot", (76.9, 21.5), (866, 14))],
        "edge": [("robot", (43.1, 5.7), (560, 14)), ("service", (18.2, 4.2), (4032, 176))],
        "commercial": [("robot", (47.1, 5.2), (552, 14)), ("service", (26.7, 4.8), (1264, 112))],
        "private": [("robot", (46.4, 5.4), (560, 14)), ("service", (22.9, 6.1), (1152, 153))],
    }
)
"""Table 7: of each device the processors in use [% of the device's], the memory in use [MB], of all that ran on it."""
DRAWN_TOPICS = ("cmd_vel", "odom", "scan", "tf")
"""Those of Table 4 in ascending size of their messages, as in Fig. 38, but for /tf, which the thesis finds apart."""
PERIODS_MS: Mapping[str, float] = MappingProxyType({"tf": 10.0, "odom": 100.0, "scan": 120.0, "cmd_vel": 33.0})
"""Table 4: of the messages as they are sent."""


def summary(results: Sequence[NineGoalsResult]) -> list[dict[str, Any]]:
    """Each scenario in one row, with `FIGURES`; see `skytether.lab.trial.report.summary`."""
    return report.summary(results, FIGURES)


def topics(results: Sequence[NineGoalsResult], names: Sequence[str] = DRAWN_TOPICS) -> list[dict[str, Any]]:
    """Each topic of each scenario in one row; see `skytether.lab.trial.report.topics`."""
    return report.topics(results, names, ideal_ms)


def ideal_ms(scenario: str, topic: str) -> float | None:
    """The period with which messages are sent: Table 4's, but Table 5's of commands of the robot's own computer."""
    return 1000 / 6 if (scenario, topic) == ("embedded", "cmd_vel") else PERIODS_MS.get(topic)


def compare_times(results: Sequence[NineGoalsResult], baseline: str) -> list[dict[str, Any]]:
    """Student's t-test of the completion times against those of one scenario (thesis, section 4.3.5).

    Returns:
        For each other scenario with two completed trials at least: ``t``, ``p`` of two sides, ``slower``: how much
        longer its mean time is, as a share; ``thesis_t`` and ``thesis_p``: the same of the thesis's means and
        deviations, None of what it did not run.
    """
    times: dict[str, list[float]] = {}
    for result in results:
        if result.completed:
            times.setdefault(result.scenario, []).append(result.time_s)
    base = times.get(baseline, [])
    compared = {n: values for n, values in times.items() if n != baseline and min(len(base), len(values)) > 1}
    rows = []
    if compared:  # SciPy takes long to import; it is of the extra `navigation`, which the service itself needs
        from scipy.stats import ttest_ind, ttest_ind_from_stats

        for name, values in compared.items():
            found = ttest_ind(values, base)
            slower = fmean(values) / fmean(base) - 1
            told = [THESIS[one]["time_s"] for one in (name, baseline) if one in THESIS]
            theirs = None
            if len(told) == 2:
                (mean, std), (base_mean, base_std) = told
                theirs = ttest_ind_from_stats(mean, std, THESIS_TRIALS, base_mean, base_std, THESIS_TRIALS)
            rows.append(
                {
                    "scenario": name,
                    "against": baseline,
                    "t": round(float(found.statistic), 3),
                    "p": round(float(found.pvalue), 4),
                    "slower": round(slower, 4),
                    "thesis_t": round(float(theirs.statistic), 3) if theirs is not None else None,
                    "thesis_p": round(float(theirs.pvalue), 4) if theirs is not None else None,
                }
            )
    return rows
