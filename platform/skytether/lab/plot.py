"""The picture of a walk: the trail, and the path walked, coloured by who was in control."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from skytether.robot.control.command import Source

from .measures import Sample
from .trail import Trail

_COLOURS: dict[Source, tuple[str, str]] = {
    Source.CLOUD: ("#0072b2", "guided by the service"),
    Source.FALLBACK: ("#d55e00", "local fallback"),
    Source.STOP: ("#111111", "stopped"),
}
"""Colour and legend of each source; told apart with any kind of colour vision (Okabe and Ito's set)."""

_TRAIL = "#d8d4c8"
_INK = "#3a3a3a"


def plot_walk(samples: Sequence[Sample], trail: Trail, file: Path, *, title: str, caption: str = "") -> None:
    """Write a PNG.

    Args:
        samples: The walk, in the order of time.
        trail: What was to be followed.
        file: Where to write; its folder must exist.
        title: One line above.
        caption: One line below the title, smaller: the figures.
    """
    xy = np.array([(sample.x, sample.y) for sample in samples])
    shown = np.concatenate([trail.points, xy])
    low, high = shown.min(axis=0) - 0.35, shown.max(axis=0) + 0.35
    width = 10.0
    height = min(max(width * (high[1] - low[1]) / (high[0] - low[0]), 2.5), 9.0) + 1.3
    figure = Figure(figsize=(width, height), dpi=150, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.set_aspect("equal")
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.plot(*trail.points.T, color=_TRAIL, linewidth=11, solid_capstyle="round", zorder=1)
    axes.plot(*trail.points.T, color="white", linewidth=1.2, linestyle=(0, (6, 5)), zorder=2)
    lines = [(first, last, samples[first].source) for first, last in _runs(samples)]
    axes.add_collection(
        LineCollection(
            [xy[first : last + 1] for first, last, _ in lines],
            colors=[_COLOURS[source][0] for _, _, source in lines],
            linewidths=2.2,
            capstyle="round",
            zorder=3,
        )
    )
    axes.plot(*trail.points[0], "o", color="white", markeredgecolor=_INK, markersize=9, markeredgewidth=1.8, zorder=4)
    axes.plot(*trail.points[-1], "s", color=_INK, markersize=8, zorder=4)
    for point, text in ((trail.points[0], "start"), (trail.points[-1], "end")):
        axes.annotate(text, point, (0, 13), textcoords="offset points", ha="center", color=_INK, fontsize=10)
    used = {source for _, _, source in lines}
    handles = [Line2D([], [], color=_TRAIL, linewidth=8, label=f"trail, {trail.length:.1f} m")]
    handles += [
        Line2D([], [], color=colour, linewidth=2.2, label=label)
        for source, (colour, label) in _COLOURS.items()
        if source in used
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False, fontsize=10)
    axes.set_title(f"{title}\n", loc="left", fontsize=13, fontweight="bold", color=_INK)
    axes.text(0, 1.015, caption, transform=axes.transAxes, fontsize=10, color=_INK, va="bottom")
    axes.set_xlabel("x [m]", color=_INK)
    axes.set_ylabel("y [m]", color=_INK)
    axes.grid(color="#eeeeee", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(colors=_INK, length=0)
    axes.spines[:].set_visible(False)
    figure.savefig(file, format="png")


def _runs(samples: Sequence[Sample]) -> list[tuple[int, int]]:
    """First and last index of each stretch under one source; the last point of one is the first of the next."""
    changes = [i for i, (a, b) in enumerate(pairwise(samples), 1) if a.source != b.source]
    return list(pairwise([0, *changes, len(samples) - 1]))
