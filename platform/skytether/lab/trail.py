"""The trail as the experiment sees it: a reference to draw, to look along and to measure against.

Built on purpose as a dense polyline, not from the formulas of the services that follow trails: it is the independent
check on them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Segments = Sequence[Mapping[str, float]]
"""As in the ``trail`` parameter of services: ``{"length": m}``, or ``{"radius": m, "angle": rad}``, positive: left."""

THESIS_TRAIL: Segments = (
    {"length": 1.5},
    {"radius": 1.2, "angle": 0.75},
    {"length": 1.2},
    {"radius": 1.2, "angle": -1.5},
    {"length": 1.2},
    {"radius": 1.2, "angle": 0.75},
    {"length": 1.5},
)
"""9 m of straight lines with smooth curves to both sides (Mello, thesis, section 2.5.2 and figure 13; the thesis gives
length and kind, not the measures of the pieces)."""

_SPACING = 0.01
"""Distance of the polyline's points, m: on a radius of 1 m the chord is off by 12 micrometres."""


class Pose(NamedTuple):
    """Pose in the plane: [m], [m], [rad] from the x axis, positive to the left."""

    x: float
    y: float
    heading: float


ORIGIN = Pose(0.0, 0.0, 0.0)


class Place(NamedTuple):
    """A position relative to the trail: arc length of the nearest point [m], distance from it [m], positive: left."""

    s: float
    offset: float


class Trail:
    """A polyline along the segments; it starts at the origin with heading 0."""

    def __init__(self, segments: Segments = THESIS_TRAIL) -> None:
        """Raises ValueError for no segments, and for one that is neither a straight line nor an arc of some length."""
        if not segments:
            raise ValueError("trail: it needs at least one segment")
        headings, steps = [], []
        heading = 0.0
        for segment in segments:
            length, turn = _length_and_turn(segment)
            count = math.ceil(length / _SPACING)
            # Midpoint rule: each chord points along the mean heading of its piece of arc.
            headings.append(heading + turn * (np.arange(count) + 0.5) / count)
            steps.append(np.full(count, length / count))
            heading += turn
        self._headings = np.concatenate(headings)
        step = np.concatenate(steps)
        self.points: NDArray[np.float64] = np.zeros((len(step) + 1, 2))
        """Points of the polyline, shape (n, 2), m."""
        self.points[1:, 0] = np.cumsum(step * np.cos(self._headings))
        self.points[1:, 1] = np.cumsum(step * np.sin(self._headings))
        self._s = np.concatenate([[0.0], np.cumsum(step)])
        self.length = float(self._s[-1])
        """Arc length of the whole, m."""
        self.end = Pose(float(self.points[-1, 0]), float(self.points[-1, 1]), heading)

    def at(self, s: float) -> Pose:
        """Pose of the trail at arc length s, limited to its ends."""
        x = float(np.interp(s, self._s, self.points[:, 0]))
        y = float(np.interp(s, self._s, self.points[:, 1]))
        index = min(max(int(np.searchsorted(self._s, s)) - 1, 0), len(self._headings) - 1)
        return Pose(x, y, float(self._headings[index]))

    def locate(self, x: float, y: float, low: float = 0.0, high: float = math.inf) -> Place:
        """Where (x, y) is, looking only between the arc lengths ``low`` and ``high``."""
        first = min(int(np.searchsorted(self._s, low)), len(self._s) - 1)
        last = max(int(np.searchsorted(self._s, high)), first + 1)
        delta = self.points[first:last] - (x, y)
        nearest = first + int(np.argmin(np.einsum("ij,ij->i", delta, delta)))
        # Along the tangent from the nearest point to the foot, which an end of the trail or of the window may cut off.
        heading = self._headings[min(nearest, len(self._headings) - 1)]
        dx, dy = x - self.points[nearest, 0], y - self.points[nearest, 1]
        s = float(self._s[nearest] + dx * math.cos(heading) + dy * math.sin(heading))
        across = float(dy * math.cos(heading) - dx * math.sin(heading))
        foot = min(max(s, low, 0.0), high, self.length)
        return Place(foot, math.copysign(math.hypot(across, s - foot), across))


class Progress:
    """How far along the trail a walk has come, in order: it only grows, and never skips a part."""

    def __init__(self, trail: Trail, *, reach: float = 0.5, corridor: float = 1.0) -> None:
        """It looks at most ``reach`` m ahead of where it is, and counts nothing further than ``corridor`` m away."""
        self._trail, self._reach, self._corridor = trail, reach, corridor
        self.s = 0.0
        """Arc length reached, m."""
        self.offset = 0.0
        """Distance from the trail at the last update, m, positive to its left."""

    def update(self, x: float, y: float) -> float:
        """Take a position; returns the arc length reached."""
        place = self._trail.locate(x, y, self.s, self.s + self._reach)
        self.offset = place.offset
        if abs(place.offset) <= self._corridor:
            self.s = max(self.s, place.s)
        return self.s


def _length_and_turn(segment: Mapping[str, float]) -> tuple[float, float]:
    if set(segment) == {"length"}:
        length, turn = segment["length"], 0.0
    elif set(segment) == {"radius", "angle"}:
        length, turn = segment["radius"] * abs(segment["angle"]), segment["angle"]
    else:
        raise ValueError(f"trail: a segment is {{length}} or {{radius, angle}}, not {dict(segment)}")
    if not 0 < length < math.inf:
        raise ValueError(f"trail: a segment must be longer than 0 m, not {dict(segment)}")
    return length, turn
