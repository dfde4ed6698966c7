"""Trials of `nine_goals` as pictures, drawn like Figs. 36 to 39 of the thesis (Mello, section 5.6.3)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from .nine_goals_report import DRAWN_TOPICS, THESIS, ideal_ms
from .nine_goals_result import NineGoalsResult
from .trial.drawing import (
    PERSON,
    PLAN,
    WAY,
    by_scenario,
    draw_beside_thesis,
    draw_loss,
    draw_periods,
    draw_throughput,
    grid,
    legend,
    mean,
    save,
    subtitle,
    titled,
)
from .world.picture import draw_plan
from .world.plan import Plan

_AROUND = 2.0
"""Shown around the ways between two goals, m."""


def draw_figures(results: Sequence[NineGoalsResult], plan: Plan, folder: Path) -> list[Path]:
    """Write five PNGs: ``fig36-paths``, ``fig37-throughput``, ``fig38-loss``, ``fig39-periods``, ``times``.

    Args:
        results: Completed or not; scenarios in the order in which they come first.
        plan: In which they were driven.
        folder: Made if missing.

    Raises:
        ValueError: There are no results.
        OSError: They cannot be written.
    """
    if not results:
        raise ValueError("there is no trial to draw")
    by_name = by_scenario(results)
    timed = [topic for topic in DRAWN_TOPICS if topic != "tf"]
    times = {name: figures["time_s"] for name, figures in THESIS.items()}
    periods = draw_periods(by_name, timed, ideal_ms, "Jitter: periods of arrival (Fig. 39)", "Tables 4 and 5")
    taken = draw_beside_thesis(by_name, lambda one: one.time_s, times, "time to the last goal [s]", "Completion time")
    made = (
        ("fig36-paths", _paths(by_name, plan)),
        ("fig37-throughput", draw_throughput(by_name, "Throughput from the robot to the service (Fig. 37)")),
        ("fig38-loss", draw_loss(by_name, DRAWN_TOPICS, "Messages lost, of each topic, over the trials (Fig. 38)")),
        ("fig39-periods", periods),
        ("times", taken),
    )
    return save(made, folder)


def _paths(by_name: Mapping[str, Sequence[NineGoalsResult]], plan: Plan) -> Figure:
    """Fig. 36: what was planned, and driven, around the person who steps into the way from goal 1 to goal 2."""
    names = list(by_name)
    first, second = plan.goals[0], plan.goals[min(1, len(plan.goals) - 1)]
    low = min(first.x, second.x) - _AROUND, min(first.y, second.y) - _AROUND / 2
    high = max(first.x, second.x) + _AROUND, max(first.y, second.y) + _AROUND
    figure, axes = grid(len(names), 2, (6.0, 3.6))
    for ax, name in zip(axes, names, strict=True):
        draw_plan(ax, plan)
        ax.set_xlim(low[0], high[0])
        ax.set_ylim(low[1], high[1])
        lengths = []
        for one in by_name[name]:
            traces = one.traces
            for path in traces.plans:
                ax.plot(*np.array(path).T, color=PLAN, linewidth=0.7, alpha=0.6, zorder=5)
            if len(traces.goals) > 1:
                leg = np.array(traces.way[traces.goals[0] : traces.goals[1] + 1])
                ax.plot(*leg.T, color=WAY, linewidth=1.8, zorder=6)
                lengths.append(one.first_leg_m)
            if traces.person:
                ax.plot(*np.array(traces.person).T, color=PERSON, linewidth=1.2, zorder=4)
        subtitle(ax, f"{name}: {mean(lengths)} m from goal 1 to 2")
    legend(figure, (PLAN, "planned"), (WAY, "driven"), (PERSON, "person"))
    return titled(figure, "Around a person who steps into the way (Fig. 36)")
