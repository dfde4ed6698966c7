"""Trials of `follow_in_front` as pictures: ways, and those drawn like Figs. 31 to 33 of the thesis (section 5.5.3)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from operator import attrgetter
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from .follow_in_front_report import DRAWN_TOPICS, LABELS, THESIS, TIMED_TOPICS, ideal_ms
from .follow_in_front_result import FollowResult
from .trial.drawing import (
    INK,
    PERSON,
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
from .world.lemniscate import Lemniscate
from .world.picture import draw_plan
from .world.plan import hall

_AROUND = 0.6
"""Shown around the path, m."""
_MARKS = "#b8b0a0"


def draw_figures(results: Sequence[FollowResult], folder: Path) -> list[Path]:
    """Write six PNGs: ``ways``, ``fig31-throughput``, ``fig32-loss``, ``fig33-periods``, ``times``, ``kte``.

    Args:
        results: Completed or not; scenarios in the order in which they come first.
        folder: Made if missing.

    Raises:
        ValueError: There are no results.
        OSError: They cannot be written.
    """
    if not results:
        raise ValueError("there is no trial to draw")
    by_name = by_scenario(results)
    made = (
        ("ways", _ways(by_name)),
        ("fig31-throughput", draw_throughput(by_name, "Throughput, robot to service (Fig. 31)", mega=True)),
        ("fig32-loss", draw_loss(by_name, DRAWN_TOPICS, "Messages lost over the trials (Fig. 32)", LABELS)),
        ("fig33-periods", _periods(by_name)),
        ("times", _beside_thesis(by_name, "time_s", "one round [s]", "Completion time")),
        ("kte", _beside_thesis(by_name, "kte_m", "KTE [m]", "Kinematic tracking error")),
    )
    return save(made, folder)


def _periods(by_name: Mapping[str, Sequence[FollowResult]]) -> Figure:
    title = "Jitter: periods of arrival (Fig. 33)"
    return draw_periods(by_name, TIMED_TOPICS, ideal_ms, title, "Table 2", LABELS)


def _beside_thesis(by_name: Mapping[str, Sequence[FollowResult]], field: str, what: str, title: str) -> Figure:
    told = {name: row[field] for name, row in THESIS.items()}
    return draw_beside_thesis(by_name, attrgetter(field), told, what, title, from_zero=True)


def _ways(by_name: Mapping[str, Sequence[FollowResult]]) -> Figure:
    """Where robot and operator went, over the marks on the floor."""
    curve = Lemniscate()
    low, high = curve.points.min(axis=0) - _AROUND, curve.points.max(axis=0) + _AROUND
    figure, axes = grid(len(by_name), 2, (6.5, 3.2))
    for ax, (name, mine) in zip(axes, by_name.items(), strict=True):
        draw_plan(ax, hall())
        ax.set_xlim(low[0], high[0])
        ax.set_ylim(low[1], high[1])
        ax.plot(*curve.points.T, color=_MARKS, linewidth=5, zorder=3)
        for one in mine:
            if one.traces.operator:
                ax.plot(*np.array(one.traces.operator).T, color=PERSON, linewidth=0.7, alpha=0.5, zorder=5)
            if one.traces.way:
                ax.plot(*np.array(one.traces.way).T, color=WAY, linewidth=1.2, alpha=0.8, zorder=6)
        ax.plot(*curve.points[0], "o", color="white", markeredgecolor=INK, markersize=7, zorder=7)
        ax.plot([high[0] - 1.2, high[0] - 0.2], [low[1] + 0.2] * 2, color=INK, linewidth=2)
        ax.annotate("1 m", (high[0] - 0.7, low[1] + 0.2), (0, 4), textcoords="offset points", ha="center", color=INK)
        subtitle(ax, f"{name}: KTE {mean([one.kte_m for one in mine if one.completed])} m")
    legend(figure, (_MARKS, "marks on the floor"), (WAY, "robot"), (PERSON, "operator"))
    return titled(figure, "One round, the robot ahead of the person who steers it")
