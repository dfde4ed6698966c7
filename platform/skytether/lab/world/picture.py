"""The world from above, drawn from its geometry: a PNG of a whole run, a GIF of how it went. Needs no OpenGL."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from skytether.lab.trail import Pose
from skytether.messages import LaserScan

from .contacts import Contact
from .people import Stance
from .plan import Plan
from .robot import RobotParams
from .simulation import Simulation

_INK, _WALL, _THING, _NEW, _GOAL = "#3a3a3a", "#4a4a4a", "#b9b3a4", "#d9c27a", "#009e73"
_ROBOTS = ("#0072b2", "#cc79a7", "#56b4e9", "#009e73")
"""Told apart with any kind of colour vision (Okabe and Ito's set), as the other colours are."""
_PERSON, _SCAN = "#d55e00", "#e69f00"
_MARGIN = 0.4
"""Around the plan, m."""
_GIF_WIDTH = 720
"""Pixels."""
_RAYS = 4
"""Every so many rays are drawn."""


@dataclass(frozen=True, slots=True)
class Frame:
    """One moment.

    Attributes:
        time: Simulated [s].
        poses: Of the robots.
        people: Where they stand.
        hits: End points of the first robot's laser rays [m], shape (n, 2).
    """

    time: float
    poses: tuple[Pose, ...]
    people: tuple[Stance, ...]
    hits: NDArray[np.float64]


def frame(simulation: Simulation) -> Frame:
    """What is now."""
    robot = simulation.robots[0]
    hits = np.empty((0, 2)) if robot.scan is None else _hits(robot.scan, robot.pose, simulation.params)
    return Frame(simulation.time, tuple(r.pose for r in simulation.robots), simulation.stances, hits)


def draw_run(
    plan: Plan,
    frames: Sequence[Frame],
    file: Path,
    *,
    contacts: Sequence[Contact] = (),
    title: str = "",
    way: Sequence[tuple[float, float]] = (),
) -> None:
    """Write a PNG: the plan, the ways of robots and people, contacts.

    Args:
        plan: What stands there.
        frames: The run, in the order of time; at least one.
        file: Where to write; its folder must exist.
        contacts: Marked where they began.
        title: One line above.
        way: A way to compare with, drawn thinly.
    """
    figure = _figure(plan, width=12.0, dpi=120, room=0.6)
    axes = figure.add_axes((0.05, 0.08, 0.93, 0.84))
    draw_plan(axes, plan)
    if way:
        axes.plot(*np.array(way).T, color=_INK, linewidth=1, linestyle=(0, (4, 4)), zorder=3)
    for index, _ in enumerate(plan.starts[: len(frames[0].poses)]):
        xy = np.array([f.poses[index][:2] for f in frames])
        axes.plot(*xy.T, color=_ROBOTS[index], linewidth=2, zorder=5, label=f"robot {index}")
    for index in range(len(frames[0].people)):
        xy = np.array([f.people[index].trunk for f in frames])
        axes.plot(*xy.T, color=_PERSON, linewidth=1.2, zorder=4, label="people" if index == 0 else None)
    if contacts:
        places = [(c.x, c.y) for c in contacts]
        axes.plot(
            *np.array(places).T, "x", color="#cc0000", markersize=11, markeredgewidth=2.5, zorder=7, label="contact"
        )
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.03), ncols=6, frameon=False)
    axes.set_title(title, loc="left", fontsize=13, fontweight="bold", color=_INK)
    figure.savefig(file, format="png")


def draw_gif(plan: Plan, frames: Sequence[Frame], file: Path, *, speed: float = 4.0, params: RobotParams) -> None:
    """Write a GIF that repeats.

    Args:
        plan: What stands there.
        frames: In the order of time; at least one.
        file: Where to write; its folder must exist.
        speed: So many times as fast as it was.
        params: Of the robots.
    """
    figure = _figure(plan, width=_GIF_WIDTH / 100, dpi=100, room=0.0)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    draw_plan(axes, plan)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()  # type: ignore[no-untyped-call]
    pixels = np.asarray(canvas.buffer_rgba())  # type: ignore[no-untyped-call]
    ground = Image.fromarray(pixels).convert("RGB")
    to_pixels = _Pixels(plan, ground.size)
    pictures = [_picture(ground, to_pixels, one, params) for one in frames]
    # One palette for all: the ground must not flicker.
    palette = pictures[len(pictures) // 2].quantize(64)
    shown = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    pause = (frames[-1].time - frames[0].time) / max(len(frames) - 1, 1) / speed
    shown[0].save(file, save_all=True, append_images=shown[1:], duration=max(20, round(pause * 1000)), loop=0)


class _Pixels:
    """From metres to pixels of a picture that is filled by the plan."""

    def __init__(self, plan: Plan, size: tuple[int, int]) -> None:
        self._x, self._y, x_max, _ = _shown(plan)
        self._height = size[1]
        self.scale = size[0] / (x_max - self._x)

    def __call__(self, x: float, y: float) -> tuple[float, float]:
        return (x - self._x) * self.scale, self._height - (y - self._y) * self.scale


def _picture(ground: Image.Image, at: _Pixels, one: Frame, params: RobotParams) -> Image.Image:
    picture = ground.copy()
    draw = ImageDraw.Draw(picture)
    for x, y in one.hits[::_RAYS]:
        u, v = at(x, y)
        draw.ellipse((u - 1.5, v - 1.5, u + 1.5, v + 1.5), fill=_SCAN)
    for stance in one.people:
        for (x, y), radius in zip(stance, (0.1, 0.1, 0.16), strict=True):
            u, v = at(x, y)
            r = radius * at.scale
            draw.ellipse((u - r, v - r, u + r, v + r), fill=_PERSON)
    for pose, colour in zip(one.poses, _ROBOTS, strict=False):
        cos, sin = math.cos(pose.heading), math.sin(pose.heading)
        outline = [at(pose.x + cos * x - sin * y, pose.y + sin * x + cos * y) for x, y in params.footprint()]
        draw.polygon(outline, fill=colour)
        nose = at(pose.x + cos * params.length / 2, pose.y + sin * params.length / 2)
        draw.line((at(pose.x, pose.y), nose), fill="white", width=2)
    draw.text((6, 4), f"{one.time:.1f} s", fill=_INK)
    return picture


def _shown(plan: Plan) -> tuple[float, float, float, float]:
    x_min, y_min, x_max, y_max = plan.bounds()
    return x_min - _MARGIN, y_min - _MARGIN, x_max + _MARGIN, y_max + _MARGIN


def _figure(plan: Plan, *, width: float, dpi: int, room: float) -> Figure:
    x_min, y_min, x_max, y_max = _shown(plan)
    figure = Figure(figsize=(width, width * (y_max - y_min) / (x_max - x_min) + room), dpi=dpi, facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def draw_plan(axes: Axes, plan: Plan) -> None:
    """Walls, things and goals from above, on axes in metres."""
    x_min, y_min, x_max, y_max = _shown(plan)
    axes.set_xlim(x_min, x_max)
    axes.set_ylim(y_min, y_max)
    axes.set_aspect("equal")
    axes.axis("off")
    shapes = [(Polygon(box.corners()), _WALL if box.wall else _colour(box.mapped)) for box in plan.boxes]
    rounds = [(Circle((c.x, c.y), c.radius), _colour(c.mapped)) for c in plan.cylinders]
    patches = [*shapes, *rounds]
    axes.add_collection(
        PatchCollection([p for p, _ in patches], facecolors=[c for _, c in patches], edgecolors="none", zorder=2)
    )
    for number, goal in enumerate(plan.goals, 1):
        axes.plot(
            goal.x, goal.y, "o", color="white", markeredgecolor=_GOAL, markersize=15, markeredgewidth=1.5, zorder=3
        )
        axes.annotate(str(number), (goal.x, goal.y), ha="center", va="center", color=_GOAL, fontsize=9, zorder=4)


def _colour(mapped: bool) -> str:
    return _THING if mapped else _NEW


def _hits(scan: LaserScan, pose: Pose, params: RobotParams) -> NDArray[np.float64]:
    angles = pose.heading + scan.angle_min + np.arange(len(scan.ranges)) * scan.angle_increment
    ranges = np.asarray(scan.ranges, np.float64)
    seen = np.isfinite(ranges)
    x = pose.x + params.laser_x * math.cos(pose.heading) + ranges[seen] * np.cos(angles[seen])
    y = pose.y + params.laser_x * math.sin(pose.heading) + ranges[seen] * np.sin(angles[seen])
    return np.stack([x, y], axis=1)
