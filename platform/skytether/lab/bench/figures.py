"""The rows as pictures: delays and losses of transports side by side, and the thesis's figure 26."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from . import traffic
from .rows import Row, arrival_rate
from .suites import FIG26_TOPICS, fig26_cell

_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f7f7f", "#8c564b", "#111111")
"""Told apart with any kind of colour vision (Okabe and Ito's set, and two)."""
_CONTOURS_MBPS = (0.1, 0.5, 1, 5, 10, 20)
_WORST_PERCENT = 10.0
"""Loss at the end of figure 26's colour map."""


def draw(suite: str, rows: Sequence[Row], folder: Path) -> list[Path]:
    """Write all pictures that a suite's rows make.

    Returns:
        The files, PNG.
    """
    if suite == "fig26":
        names = dict.fromkeys(row.transport for row in rows)
        return [_fig26([r for r in rows if r.transport == name], folder / f"fig26-{name}.png") for name in names]
    if suite == "throughput":
        return [_throughput(rows, folder / "throughput.png")]
    conditions = dict.fromkeys(row.condition for row in rows)
    return [
        _compare([r for r in rows if r.condition == name], folder / f"{_file_name(name)}.png") for name in conditions
    ]


def _compare(rows: Sequence[Row], file: Path) -> Path:
    """Delays (median to 99th percentile, and the largest) and losses by topic, one colour for each transport."""
    topics = list(dict.fromkeys(row.topic for row in rows))
    transports = list(dict.fromkeys(row.transport for row in rows))
    figure = _figure(11, 1.4 + 0.11 * len(topics) * (len(transports) + 1.5))
    delays, losses = figure.subplots(1, 2, sharey=True, width_ratios=(3, 1))
    step = 0.8 / len(transports)
    for row in rows:
        number = transports.index(row.transport)
        y = topics.index(row.topic) + step * (number - (len(transports) - 1) / 2)
        colour = _COLOURS[number % len(_COLOURS)]
        if row.delay_p50_ms is not None and row.delay_p99_ms is not None:
            delays.plot([row.delay_p50_ms, row.delay_p99_ms], [y, y], color=colour, linewidth=3)
            delays.plot(row.delay_max_ms, y, ".", color=colour, markersize=5)
        losses.barh(y, 100 * row.lost, height=step * 0.9, color=colour)
        losses.plot(0, y, "|", color=colour)
    delays.set_xscale("log")
    delays.xaxis.set_major_formatter("{x:g}")
    delays.xaxis.set_minor_formatter("{x:g}")
    delays.set_yticks(range(len(topics)), topics)
    delays.invert_yaxis()
    delays.set_xlabel("delay one way: median to 99th percentile, and largest [ms]")
    losses.set_xlabel("not delivered [%]")
    losses.set_xlim(left=0, right=max(1.0, *(105 * row.lost for row in rows)))
    for axes in (delays, losses):
        axes.grid(axis="x", color="#e6e6e6")
        axes.set_axisbelow(True)
    for number, name in enumerate(transports):
        delays.plot([], [], color=_COLOURS[number % len(_COLOURS)], linewidth=3, label=name)
    figure.legend(loc="outside lower center", ncols=min(len(transports), 5), frameon=False)
    figure.suptitle(rows[0].condition)
    return _save(figure, file)


def _fig26(rows: Sequence[Row], file: Path) -> Path:
    """As the thesis draws it: a marker with the loss for each cell, dashed contours of equal bandwidth."""
    figure = _figure(6.5 * len(FIG26_TOPICS), 5.5)
    for axes, topics in zip(figure.subplots(1, len(FIG26_TOPICS), squeeze=False)[0], FIG26_TOPICS, strict=True):
        _bandwidths(axes)
        for kb in traffic.SIZES_KB:
            for hz in traffic.RATES_HZ:
                cell = [r for r in rows if r.condition == fig26_cell(topics, kb, hz)]
                if cell:
                    sent, delivered = sum(r.sent for r in cell), sum(r.delivered for r in cell)
                    _marker(axes, hz, kb, 100 * (1 - delivered / sent) if sent else 0.0)
        axes.set_xlabel("message rate, all topics together [Hz]")
        axes.set_ylabel("message size [kB]")
        axes.set_title(f"{topics} topic{'s' if topics > 1 else ''}: message loss [%]")
    frames = [r for r in rows if any(r.condition == fig26_cell(1, traffic.FRAME_KB, f) for f in traffic.FRAME_RATES_HZ)]
    beside = "; ".join(f"{r.condition.removeprefix('1 topic, ')}: {100 * r.lost:.2f} %" for r in frames)
    figure.suptitle(f"{rows[0].transport} on loopback. Beside it, {beside}" if beside else rows[0].transport)
    return _save(figure, file)


def _marker(axes: Axes, hz: float, kb: float, loss: float) -> None:
    axes.scatter(hz, kb, s=620, c=[loss], cmap="RdYlGn_r", vmin=0, vmax=_WORST_PERCENT, edgecolors="#444444", zorder=2)
    axes.annotate(f"{loss:.1f}", (hz, kb), ha="center", va="center", fontsize=8, zorder=3)


def _bandwidths(axes: Axes) -> None:
    rates, sizes = np.meshgrid(np.linspace(1, 215, 100), np.linspace(0.1, 17.5, 100))
    mbps = rates * sizes * traffic.KB * 8 / 1e6
    lines = axes.contour(
        rates, sizes, mbps, levels=_CONTOURS_MBPS, colors="#888888", linestyles="dashed", linewidths=0.9
    )
    axes.clabel(lines, fmt="%g Mbit/s", fontsize=7)


def _throughput(rows: Sequence[Row], file: Path) -> Path:
    """What arrived over what was offered, for large and for small messages."""
    figure = _figure(11, 4.5)
    sizes = sorted({row.size for row in rows}, reverse=True)
    for axes, size in zip(figure.subplots(1, len(sizes), squeeze=False)[0], sizes, strict=True):
        unit, scale = ("Mbit/s", size * 8 / 1e6) if size >= traffic.KB else ("messages/s", 1.0)
        for number, name in enumerate(dict.fromkeys(row.transport for row in rows)):
            chosen = [r for r in rows if r.transport == name and r.size == size]
            colour = _COLOURS[number % len(_COLOURS)]
            sent = [r.sent / r.seconds * scale for r in chosen]
            axes.plot(sent, [arrival_rate(r) * scale for r in chosen], "o-", color=colour, label=name)
        axes.axline((0, 0), slope=1, color="#bbbbbb", linestyle="dashed", zorder=1)
        axes.set_xlabel(f"sent [{unit}]")
        axes.set_ylabel(f"delivered [{unit}]")
        axes.set_title(f"messages of {size:,} bytes")
        axes.grid(color="#e6e6e6")
        axes.legend(frameon=False)
    return _save(figure, file)


def _figure(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), dpi=130, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _save(figure: Figure, file: Path) -> Path:
    figure.savefig(file, format="png")
    return file


def _file_name(condition: str) -> str:
    return condition.replace("%", "").replace(" ", "-")
