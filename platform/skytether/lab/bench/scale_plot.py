"""The picture of a measurement of scale: what each instance costs, over their number."""

from __future__ import annotations

from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from .scale import Scale

_LINES = (
    ("pass_us_each", "pass over the site, each instance [us]", "#0072b2"),
    ("placer_us_each", "pass of the placer, each instance [us]", "#d55e00"),
)


def plot_scale(found: Scale, file: Path) -> None:
    """Write a PNG; its folder must exist."""
    figure = Figure(figsize=(8.0, 4.0), dpi=130, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    instances = [row.instances for row in found.rows]
    for name, label, colour in _LINES:
        left.plot(instances, [getattr(row, name) for row in found.rows], "o-", color=colour, label=label)
    left.set_ylim(bottom=0)
    left.set_title("What a look at all costs")
    right.plot(instances, [row.memory_mb for row in found.rows], "o-", color="#009e73", label="memory [MiB]")
    right.plot(instances, [100 * row.cpu for row in found.rows], "o-", color="#cc79a7", label="processor [% of a core]")
    right.set_ylim(bottom=0)
    right.set_title("The orchestrator, nobody asks")
    for axes in (left, right):
        axes.set_xscale("log")
        axes.set_xlabel("instances")
        axes.legend(frameon=False, fontsize=8)
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(file)
