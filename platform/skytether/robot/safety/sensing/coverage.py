"""Which directions are looked into, and whether the robot moves into one that is not. Pure geometry.

Directions are cells of a quarter of a degree around each sensor, so that neither the seam at half a turn nor whole
turns more or less make a difference. A cell counts only if all of it is looked into.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from math import ceil, floor, hypot, inf, tau

import numpy as np
from numpy.typing import NDArray

from skytether.control.admittance import Velocity

from ..geometry.footprint import Footprint, Points
from ..geometry.sweep import moved

CELLS = 1440
"""Of a whole turn."""
_CELL = tau / CELLS
_ROUNDING = 0.01
"""Cells that count as none: float32 angles, added up."""
_SPACING_M = 0.025
"""Between points of the outline that are looked at."""
_MOST_POINTS = 400
"""Of the outline; of larger robots they are farther apart."""
_POSES = 5
"""On the way ahead, each at half the distance of the next."""

Cells = NDArray[np.bool_]


class Action(StrEnum):
    """What to do about what is not seen."""

    STOP = "stop"
    SLOW = "slow"
    FREE = "free"


def no_cells() -> Cells:
    """Nothing is looked into."""
    return np.zeros(CELLS, dtype=bool)


def sector(first: float, last: float, *, touched: bool = False) -> Cells:
    """Cells from one angle counter-clockwise to another [rad]; ``last`` below ``first`` goes over the seam.

    Args:
        first: Where it begins.
        last: Where it ends; a turn or more after ``first`` is all around.
        touched: Also the cells at its ends of which it has only a part.
    """
    width = last - first if last >= first else (last - first) % tau
    if width >= tau - _CELL * _ROUNDING:
        return np.ones(CELLS, dtype=bool)
    start, end = first / _CELL, (first + width) / _CELL
    begin = floor(start + _ROUNDING) if touched else ceil(start - _ROUNDING)
    stop = ceil(end - _ROUNDING) if touched else floor(end + _ROUNDING)
    cells = no_cells()
    cells[np.arange(begin, max(stop, begin)) % CELLS] = True
    return cells


def between(angles: NDArray[np.float64], step: float, gap: float) -> Cells:
    """Cells that rays look into.

    Args:
        angles: Of the rays, rising, over little more than a turn [rad].
        step: From one ray to the next where none is missing [rad].
        gap: Widest sector without a ray that counts as looked into [rad].
    """
    if not len(angles):
        return no_cells()
    most = step + gap + _CELL * _ROUNDING
    apart = np.diff(angles) > most
    starts = angles[np.concatenate(([True], apart))]
    ends = angles[np.concatenate((apart, [True]))]
    if starts[0] + tau - ends[-1] <= most:  # around the seam
        ends[-1] = max(ends[-1], ends[0] + tau)
    first = np.ceil(starts / _CELL - _ROUNDING).astype(np.int64)
    last = np.floor(ends / _CELL + _ROUNDING).astype(np.int64)
    first, last = first[last > first], last[last > first]
    if not len(first):
        return no_cells()
    base = int(first[0] // CELLS) * CELLS
    turns = -(-(int(last.max()) - base) // CELLS)
    steps = np.zeros(turns * CELLS + 1, dtype=np.int64)
    np.add.at(steps, first - base, 1)
    np.add.at(steps, last - base, -1)
    looked: NDArray[np.bool_] = np.greater(np.cumsum(steps)[:-1], 0).reshape(turns, CELLS)
    seen: Cells = np.any(looked, axis=0)
    return seen


def widest(cells: Cells) -> float:
    """The widest sector of neighbouring cells [rad]."""
    if cells.all():
        return tau
    if not cells.any():
        return 0.0
    flags = np.roll(cells, -int(np.argmin(cells)))  # begins with a cell that is none
    edges = np.flatnonzero(np.diff(np.concatenate(([False], flags, [False]))))
    return float((edges[1::2] - edges[::2]).max(initial=0)) * _CELL


@dataclass(frozen=True, eq=False)
class Cover:
    """Where one sensor looks.

    Attributes:
        x: The sensor's place in the base frame [m].
        y: The same, to the left [m].
        yaw: Direction of its x axis in the base frame [rad].
        sense: -1 if its angles count to the right (mounted head over), else 1.
        reach: How far it looks into each cell, in its own angles [m]; 0: not at all, inf: as far as it measures.
        near: What is nearer to it than this it does not see [m]; one for all cells, or of each.
    """

    x: float
    y: float
    yaw: float
    sense: float
    reach: NDArray[np.float64]
    near: float | NDArray[np.float64] = 0.0

    @property
    def everywhere(self) -> bool:
        """Whether it looks at every point there is."""
        return bool((self.reach == inf).all()) and not np.any(self.near)

    def looks_at(self, points: Points) -> NDArray[np.bool_]:
        """Which of the points (base frame, shape (n, 2), m) are where it looks."""
        dx, dy = points[:, 0] - self.x, points[:, 1] - self.y
        angles = self.sense * (np.arctan2(dy, dx) - self.yaw)
        cells = np.floor(angles / _CELL).astype(np.int64) % CELLS
        away = np.hypot(dx, dy)
        found: NDArray[np.bool_] = (away < self.reach[cells]) & (away >= np.broadcast_to(self.near, CELLS)[cells])
        return found


@dataclass(frozen=True, slots=True)
class UnseenParams:
    """What to do about moving where no sensor looks.

    Attributes:
        action: Not go there at all, slowly, or as if it were seen.
        near_m: So near to the outline nothing needs to be looked at: it was seen before it came there [m].
    """

    action: Action = Action.SLOW
    near_m: float = 0.05


class Unseen:
    """Limits how fast the outline moves where no sensor looks: backwards, sideways, with a corner that swings out.

    Args:
        params: What to do about it.
        footprint: Outline of the robot with all that it carries.
        speed: At which a point of the outline may go there [m/s].
    """

    def __init__(self, params: UnseenParams, footprint: Footprint, speed: float) -> None:
        self._params = params
        self._footprint = footprint
        self._speed = speed
        self._outline = _along(footprint)

    def share(self, velocity: Velocity, covers: Sequence[Cover], way: float) -> float:
        """What share of a velocity is slow enough for what is not looked at.

        Args:
            velocity: What is wanted.
            covers: Where each sensor looks.
            way: Of the outermost corner that must be looked at: what it needs to stop, and room [m].
        """
        speed = hypot(velocity.linear, velocity.angular * self._footprint.radius)
        if self._params.action is Action.FREE or speed == 0 or any(cover.everywhere for cover in covers):
            return 1.0
        longest = max(way, 2 * self._params.near_m)
        least = inf
        for pose in range(_POSES):
            time = longest / speed / 2**pose
            points = moved(self._outline, velocity, time)
            beyond = self._footprint.outside(points)
            points, beyond = points[beyond > self._params.near_m], beyond[beyond > self._params.near_m]
            if not len(points):
                break
            unseen = np.ones(len(points), dtype=bool)
            for cover in covers:
                unseen &= ~cover.looks_at(points)
            if unseen.any():
                if self._params.action is Action.STOP:
                    return 0.0
                least = min(least, self._speed * time / float(beyond[unseen].max()))
        return min(1.0, least)


def _along(footprint: Footprint) -> Points:
    """Points along the outline."""
    starts = footprint.vertices
    sides = np.roll(starts, -1, axis=0) - starts
    lengths = np.hypot(sides[:, 0], sides[:, 1])
    spacing = max(_SPACING_M, float(lengths.sum()) / _MOST_POINTS)
    return np.concatenate(
        [
            start + side * np.linspace(0, 1, max(1, ceil(length / spacing)), endpoint=False)[:, None]
            for start, side, length in zip(starts, sides, lengths, strict=True)
        ]
    )
