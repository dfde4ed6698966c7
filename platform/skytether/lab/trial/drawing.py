"""Pictures that every experiment draws of its trials: throughput, loss, periods, times; and their parts.

Each of the large ones gets results by scenario, in the order in which scenarios are drawn.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from .report import Ideal, Pair
from .results import R, TrialResult

INK, WAY, PERSON, PLAN = "#3a3a3a", "#0072b2", "#d55e00", "#56b4e9"
_ARRIVED, _IDEAL = "#e69f00", "#cc0000"
_LEAST_LOSS = 0.02
"""The axis of losses reaches this far at least."""
_NO_LABELS: Mapping[str, str] = MappingProxyType({})


def by_scenario(results: Iterable[R]) -> dict[str, list[R]]:
    """Results by the names of their scenarios, as they come first."""
    found: dict[str, list[R]] = {}
    for one in results:
        found.setdefault(one.scenario, []).append(one)
    return found


def save(figures: Iterable[tuple[str, Figure]], folder: Path) -> list[Path]:
    """Write PNGs.

    Args:
        figures: With their names.
        folder: Made if missing.

    Raises:
        OSError: They cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    for name, figure in figures:
        files.append(folder / f"{name}.png")
        figure.savefig(files[-1], format="png")
    return files


def draw_throughput(by_name: Mapping[str, Sequence[TrialResult]], title: str, *, mega: bool = False) -> Figure:
    """Throughput in each second, as it left the robot, and as it came out of the network.

    Args:
        by_name: Results by scenario.
        title: Above.
        mega: In Mbit/s; else in kbit/s.
    """
    unit, per = ("Mbit/s", 1000) if mega else ("kbit/s", 1)
    figure, axes = grid(len(by_name), 2, (6.0, 3.0))
    for ax, (name, mine) in zip(axes, by_name.items(), strict=True):
        sent = [value / per for one in mine for value in one.traces.sent_kbit_s]
        arrived = [value / per for one in mine for value in one.traces.arrived_kbit_s]
        edges = np.histogram_bin_edges([*sent, *arrived] or [0.0], bins=40)
        for values, colour in ((sent, WAY), (arrived, _ARRIVED)):
            if values:
                ax.hist(values, edges.tolist(), color=colour, alpha=0.6, weights=np.full(len(values), 1 / len(values)))
        subtitle(ax, f"{name}: {mean(sent)} and {mean(arrived)} {unit}")
        tidy(ax, f"throughput [{unit}]", "share of seconds")
    legend(figure, (WAY, "robot, sent"), (_ARRIVED, "service, arrived"))
    return titled(figure, title)


def draw_loss(
    by_name: Mapping[str, Sequence[TrialResult]],
    topics: Sequence[str],
    title: str,
    labels: Mapping[str, str] = _NO_LABELS,
) -> Figure:
    """The share of each topic's messages that was lost, over the trials.

    Args:
        by_name: Results by scenario.
        topics: From left to right.
        title: Above.
        labels: Of topics that have another one than their name.
    """
    figure, axes = grid(len(by_name), 2, (6.0, 3.0))
    most = _LEAST_LOSS
    for ax, (name, mine) in zip(axes, by_name.items(), strict=True):
        columns = [_values(mine, topic, "lost") for topic in topics]
        most = max(most, *(max(column, default=0.0) for column in columns))
        _boxes(ax, [[100 * value for value in column] for column in columns], [labels.get(t, t) for t in topics])
        subtitle(ax, name)
        tidy(ax, "", "messages lost [%]")
    for ax in axes:
        ax.set_ylim(-2 * most, 105 * most)
    return titled(figure, title)


def draw_periods(
    by_name: Mapping[str, Sequence[TrialResult]],
    topics: Sequence[str],
    ideal_ms: Ideal,
    title: str,
    tables: str,
    labels: Mapping[str, str] = _NO_LABELS,
) -> Figure:
    """Periods of arrival. The bridge keeps their median and 99th percentile: a bar from one to the other.

    Args:
        by_name: Results by scenario.
        topics: Each gets its own axes.
        ideal_ms: Periods as sent.
        title: Above.
        tables: Of the thesis, which have the periods as sent.
        labels: Of topics that have another one than their name.
    """
    figure, axes = grid(len(topics), len(topics), (4.2, 3.4))
    for ax, topic in zip(axes, topics, strict=True):
        for at, (name, mine) in enumerate(by_name.items()):
            ideal = ideal_ms(name, topic) or 0.0
            ax.hlines(ideal, at - 0.4, at + 0.4, color=_IDEAL, linewidth=1.2, linestyle=(0, (5, 4)))
            middle, late = (_values(mine, topic, field) for field in ("period_ms", "period_p99_ms"))
            shift = np.linspace(-0.25, 0.25, len(middle)) if len(middle) > 1 else np.zeros(len(middle))
            ax.vlines(at + shift, middle, late, color=WAY, linewidth=2, alpha=0.5)
            ax.plot(at + shift, middle, "o", color=WAY, markersize=4)
        ax.set_xticks(range(len(by_name)), list(by_name), fontsize=8)
        ax.set_xlim(-0.6, len(by_name) - 0.4)
        ax.set_ylim(bottom=0)
        subtitle(ax, labels.get(topic, topic))
        tidy(ax, "", "period of arrival [ms]")
    legend(figure, (WAY, "of each trial: median (dot) to 99th percentile"), (_IDEAL, f"as sent ({tables})"))
    return titled(figure, title)


def draw_beside_thesis(
    by_name: Mapping[str, Sequence[R]],
    figure_of: Callable[[R], float],
    thesis: Mapping[str, Pair],
    what: str,
    title: str,
    *,
    from_zero: bool = False,
) -> Figure:
    """One number of each completed trial as a dot, beside the thesis's means and deviations.

    Args:
        by_name: Results by scenario.
        figure_of: The number.
        thesis: Of scenarios mean and standard deviation.
        what: Label of the axis.
        title: Above.
        from_zero: Whether the axis begins there.
    """
    figure, (ax,) = grid(1, 1, (8.0, 3.4))
    for at, (name, mine) in enumerate(by_name.items()):
        found = [figure_of(one) for one in mine if one.completed]
        ax.plot([at - 0.12] * len(found), found, "o", color=WAY, markersize=5, alpha=0.7)
        if name in thesis:
            middle, deviation = thesis[name]
            ax.errorbar(at + 0.12, middle, deviation, fmt="s", color=PERSON, capsize=4)
    ax.set_xticks(range(len(by_name)), list(by_name))
    ax.set_xlim(-0.6, len(by_name) - 0.4)
    if from_zero:
        ax.set_ylim(bottom=0)
    tidy(ax, "", what)
    legend(figure, (WAY, "completed trials"), (PERSON, "thesis: mean and standard deviation"))
    return titled(figure, title)


def grid(number: int, columns: int, size: tuple[float, float]) -> tuple[Figure, list[Axes]]:
    """A figure of so many axes, side by side.

    Args:
        number: Of axes.
        columns: At most.
        size: Width and height of each [inch].
    """
    columns = min(columns, number)
    rows = math.ceil(number / columns)
    width, height = max(columns * size[0], 6.0), rows * size[1] + 0.9
    figure = Figure(figsize=(width, height), dpi=120, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    return figure, [figure.add_subplot(rows, columns, number + 1) for number in range(number)]


def mean(values: Sequence[float]) -> str:
    """In three digits."""
    return f"{np.mean(values):.3g}" if values else "-"


def subtitle(ax: Axes, text: str) -> None:
    """Above the axes, to the left."""
    ax.set_title(text, loc="left", fontsize=10, color=INK)


def tidy(ax: Axes, x: str, y: str) -> None:
    """Label both axes, and take away what only adorns."""
    ax.set_xlabel(x, color=INK)
    ax.set_ylabel(y, color=INK)
    ax.grid(axis="y", color="#eeeeee", linewidth=0.8)
    ax.set_axisbelow(True)
    ax.tick_params(colors=INK, length=0)
    ax.spines[["top", "right"]].set_visible(False)


def legend(figure: Figure, *entries: tuple[str, str]) -> None:
    """Colours and what they mean, below all axes."""
    handles: list[Any] = [Line2D([], [], color=colour, linewidth=2.5, label=text) for colour, text in entries]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False, fontsize=9)


def titled(figure: Figure, text: str) -> Figure:
    """The figure, with a title."""
    figure.suptitle(text, x=0.01, ha="left", fontsize=12, fontweight="bold", color=INK)
    return figure


def _boxes(ax: Axes, columns: Sequence[Sequence[float]], names: Sequence[str]) -> None:
    shown = [(at, column) for at, column in enumerate(columns, 1) if column]
    if shown:
        ax.boxplot([column for _, column in shown], positions=[at for at, _ in shown], widths=0.5)
    ax.set_xticks(range(1, len(names) + 1), names)
    ax.set_xlim(0.4, len(names) + 0.6)


def _values(results: Sequence[TrialResult], topic: str, field: str) -> list[float]:
    found = (getattr(row, field) for one in results for row in one.topics if row.topic == topic)
    return [value for value in found if not math.isnan(value)]
