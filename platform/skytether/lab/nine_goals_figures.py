"""Trials of `nine_goals` as pictures, drawn like Figs. 36 to 39 of the thesis (Mello, section 5.6.3)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from .nine_goals_report import DRAWN_TOPICS, THESIS, ideal_ms
from .nine_goals_result import TrialResult
from .world.picture import draw_plan
from .world.plan import Plan

_INK, _WAY, _PLAN, _PERSON, _ARRIVED, _IDEAL = "#3a3a3a", "#0072b2", "#56b4e9", "#d55e00", "#e69f00", "#cc0000"
_AROUND = 2.0
"""Shown around the ways between two goals, m."""


def draw_figures(results: Sequence[TrialResult], plan: Plan, folder: Path) -> list[Path]:
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
    folder.mkdir(parents=True, exist_ok=True)
    by_name = {name: [one for one in results if one.scenario == name] for name in (r.scenario for r in results)}
    made = (
        ("fig36-paths", _paths(by_name, plan)),
        ("fig37-throughput", _throughput(by_name)),
        ("fig38-loss", _loss(by_name)),
        ("fig39-periods", _periods(by_name)),
        ("times", _times(by_name)),
    )
    files = []
    for name, figure in made:
        files.append(folder / f"{name}.png")
        figure.savefig(files[-1], format="png")
    return files


_ByName = dict[str, list[TrialResult]]


def _paths(by_name: _ByName, plan: Plan) -> Figure:
    """Fig. 36: what was planned, and driven, around the person who steps into the way from goal 1 to goal 2."""
    names = list(by_name)
    first, second = plan.goals[0], plan.goals[min(1, len(plan.goals) - 1)]
    low = min(first.x, second.x) - _AROUND, min(first.y, second.y) - _AROUND / 2
    high = max(first.x, second.x) + _AROUND, max(first.y, second.y) + _AROUND
    figure, axes = _grid(len(names), 2, (6.0, 3.6))
    for ax, name in zip(axes, names, strict=True):
        draw_plan(ax, plan)
        ax.set_xlim(low[0], high[0])
        ax.set_ylim(low[1], high[1])
        lengths = []
        for one in by_name[name]:
            traces = one.traces
            for path in traces.plans:
                ax.plot(*np.array(path).T, color=_PLAN, linewidth=0.7, alpha=0.6, zorder=5)
            if len(traces.goals) > 1:
                leg = np.array(traces.way[traces.goals[0] : traces.goals[1] + 1])
                ax.plot(*leg.T, color=_WAY, linewidth=1.8, zorder=6)
                lengths.append(one.first_leg_m)
            if traces.person:
                ax.plot(*np.array(traces.person).T, color=_PERSON, linewidth=1.2, zorder=4)
        ax.set_title(f"{name}: {_mean(lengths)} m from goal 1 to 2", loc="left", fontsize=10, color=_INK)
    _legend(figure, (_PLAN, "planned"), (_WAY, "driven"), (_PERSON, "person"))
    return _titled(figure, "Around a person who steps into the way (Fig. 36)")


def _throughput(by_name: _ByName) -> Figure:
    """Fig. 37: kbit/s in each second, as they left the robot, and as they came out of the network."""
    figure, axes = _grid(len(by_name), 2, (6.0, 3.0))
    for ax, (name, mine) in zip(axes, by_name.items(), strict=True):
        sent = [value for one in mine for value in one.traces.sent_kbit_s]
        arrived = [value for one in mine for value in one.traces.arrived_kbit_s]
        edges = np.histogram_bin_edges([*sent, *arrived] or [0.0], bins=40)
        for values, colour in ((sent, _WAY), (arrived, _ARRIVED)):
            if values:
                ax.hist(values, edges.tolist(), color=colour, alpha=0.6, weights=np.full(len(values), 1 / len(values)))
        ax.set_title(f"{name}: {_mean(sent)} and {_mean(arrived)} kbit/s", loc="left", fontsize=10, color=_INK)
        _tidy(ax, "throughput [kbit/s]", "share of seconds")
    _legend(figure, (_WAY, "robot, sent"), (_ARRIVED, "service, arrived"))
    return _titled(figure, "Throughput from the robot to the service (Fig. 37)")


def _loss(by_name: _ByName) -> Figure:
    """Fig. 38: the share of each topic's messages that was lost, over the trials."""
    figure, axes = _grid(len(by_name), 2, (6.0, 3.0))
    most = 0.02
    for ax, (name, mine) in zip(axes, by_name.items(), strict=True):
        columns = [_values(mine, topic, "lost") for topic in DRAWN_TOPICS]
        most = max(most, *(max(column, default=0.0) for column in columns))
        _boxes(ax, [[100 * value for value in column] for column in columns], DRAWN_TOPICS)
        ax.set_title(name, loc="left", fontsize=10, color=_INK)
        _tidy(ax, "", "messages lost [%]")
    for ax in axes:
        ax.set_ylim(-2 * most, 105 * most)
    return _titled(figure, "Messages lost, of each topic, over the trials (Fig. 38)")


def _periods(by_name: _ByName) -> Figure:
    """Fig. 39: periods of arrival. The bridge keeps their median and 99th percentile: a bar from one to the other."""
    names = [topic for topic in DRAWN_TOPICS if topic != "tf"]
    figure, axes = _grid(len(names), len(names), (4.2, 3.4))
    for ax, topic in zip(axes, names, strict=True):
        for at, (name, mine) in enumerate(by_name.items()):
            ideal = ideal_ms(name, topic) or 0.0
            ax.hlines(ideal, at - 0.4, at + 0.4, color=_IDEAL, linewidth=1.2, linestyle=(0, (5, 4)))
            middle, late = (_values(mine, topic, field) for field in ("period_ms", "period_p99_ms"))
            shift = np.linspace(-0.25, 0.25, len(middle)) if len(middle) > 1 else np.zeros(len(middle))
            ax.vlines(at + shift, middle, late, color=_WAY, linewidth=2, alpha=0.5)
            ax.plot(at + shift, middle, "o", color=_WAY, markersize=4)
        ax.set_xticks(range(len(by_name)), list(by_name), fontsize=8)
        ax.set_xlim(-0.6, len(by_name) - 0.4)
        ax.set_ylim(bottom=0)
        ax.set_title(topic, loc="left", fontsize=10, color=_INK)
        _tidy(ax, "", "period of arrival [ms]")
    _legend(figure, (_WAY, "of each trial: median (dot) to 99th percentile"), (_IDEAL, "as sent (Tables 4 and 5)"))
    return _titled(figure, "Jitter: periods of arrival (Fig. 39)")


def _times(by_name: _ByName) -> Figure:
    """Completion times, each trial a dot, beside the thesis's means and deviations."""
    figure, (ax,) = _grid(1, 1, (8.0, 3.4))
    for at, (name, mine) in enumerate(by_name.items()):
        times = [one.time_s for one in mine if one.completed]
        ax.plot([at - 0.12] * len(times), times, "o", color=_WAY, markersize=5, alpha=0.7)
        if name in THESIS:
            mean, deviation = THESIS[name]["time_s"]
            ax.errorbar(at + 0.12, mean, deviation, fmt="s", color=_PERSON, capsize=4)
    ax.set_xticks(range(len(by_name)), list(by_name))
    ax.set_xlim(-0.6, len(by_name) - 0.4)
    _tidy(ax, "", "time to the last goal [s]")
    _legend(figure, (_WAY, "completed trials"), (_PERSON, "thesis: mean and standard deviation"))
    return _titled(figure, "Completion time")


def _grid(number: int, columns: int, size: tuple[float, float]) -> tuple[Figure, list[Axes]]:
    columns = min(columns, number)
    rows = math.ceil(number / columns)
    width, height = max(columns * size[0], 6.0), rows * size[1] + 0.9
    figure = Figure(figsize=(width, height), dpi=120, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    return figure, [figure.add_subplot(rows, columns, number + 1) for number in range(number)]


def _boxes(ax: Axes, columns: Sequence[Sequence[float]], names: Sequence[str]) -> None:
    shown = [(at, column) for at, column in enumerate(columns, 1) if column]
    if shown:
        ax.boxplot([column for _, column in shown], positions=[at for at, _ in shown], widths=0.5)
    ax.set_xticks(range(1, len(names) + 1), names)
    ax.set_xlim(0.4, len(names) + 0.6)


def _values(results: Sequence[TrialResult], topic: str, field: str) -> list[float]:
    found = (getattr(row, field) for one in results for row in one.topics if row.topic == topic)
    return [value for value in found if not math.isnan(value)]


def _mean(values: Sequence[float]) -> str:
    return f"{np.mean(values):.3g}" if values else "-"


def _tidy(ax: Axes, x: str, y: str) -> None:
    ax.set_xlabel(x, color=_INK)
    ax.set_ylabel(y, color=_INK)
    ax.grid(axis="y", color="#eeeeee", linewidth=0.8)
    ax.set_axisbelow(True)
    ax.tick_params(colors=_INK, length=0)
    ax.spines[["top", "right"]].set_visible(False)


def _legend(figure: Figure, *entries: tuple[str, str]) -> None:
    handles: list[Any] = [Line2D([], [], color=colour, linewidth=2.5, label=text) for colour, text in entries]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False, fontsize=9)


def _titled(figure: Figure, text: str) -> Figure:
    figure.suptitle(text, x=0.01, ha="left", fontsize=12, fontweight="bold", color=_INK)
    return figure
