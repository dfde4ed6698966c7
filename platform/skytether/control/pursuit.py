"""Pure pursuit: follow a path of points by aiming at one a little ahead (Coulter, CMU-RI-TR-92-01, 1992).

With the goal point at (x, y) in the robot's frame, at the distance L, the arc that leads through it has the curvature
2 y / L^2. No clocks and no topics in here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from .admittance import STANDSTILL, Velocity
from .numbers import check_positive

Point = tuple[float, float]

_WINDOW = 1.0
"""How far ahead of the last place on the path the next one is looked for [m]: a path that crosses itself is not cut."""
_LOST = 0.5
"""Farther from the last place than this the whole path is looked at [m]."""


@dataclass(frozen=True, slots=True)
class PursuitParams:
    """How the path is followed.

    Attributes:
        speed: On a straight [m/s].
        max_angular: Fastest turn [rad/s]; where the path needs a faster one, the speed falls.
        lookahead: Distance of the point that is aimed at [m].
        end_rate: Speed per way left, near the end [1/s].
        end_reached: The end counts as reached from here on [m].
    """

    speed: float = 0.2
    max_angular: float = 0.5
    lookahead: float = 0.4
    end_rate: float = 0.8
    end_reached: float = 0.05

    def __post_init__(self) -> None:
        """Refuse what does not move or never ends.

        Raises:
            ValueError: A field is not above 0 and finite; the text names it.
        """
        check_positive(self, "path", self.__slots__)


class Track:
    """A path of points [m], by arc length; remembers how far along it one has come."""

    def __init__(self, points: Sequence[Point]) -> None:
        """Raises ValueError for fewer than two points, equal neighbours only, and numbers that are not finite."""
        if not all(math.isfinite(c) for point in points for c in point):
            raise ValueError("path: a point is not finite")
        self._points = [p for i, p in enumerate(points) if i == 0 or p != points[i - 1]]
        if len(self._points) < 2:
            raise ValueError("path: it needs at least two points that differ")
        self._s = [0.0]
        for a, b in pairwise(self._points):
            self._s.append(self._s[-1] + math.dist(a, b))
        self._place: float | None = None

    @property
    def length(self) -> float:
        """Arc length of the whole [m]."""
        return self._s[-1]

    def locate(self, x: float, y: float) -> float:
        """Arc length of the nearest point [m]: near the last one, or anywhere at first and after having been moved."""
        if self._place is not None:
            low, high = self._place, self._place + _WINDOW
            s, distance = self._nearest(x, y, low, high)
            if distance <= _LOST:
                self._place = s
                return s
        self._place = self._nearest(x, y, 0.0, math.inf)[0]
        return self._place

    def at(self, s: float) -> Point:
        """The point at an arc length [m], limited to the path's ends."""
        for i, after in enumerate(self._s[1:]):
            if s <= after or i == len(self._points) - 2:
                (ax, ay), (bx, by) = self._points[i], self._points[i + 1]
                share = min(max((s - self._s[i]) / (after - self._s[i]), 0.0), 1.0)
                return ax + share * (bx - ax), ay + share * (by - ay)
        return self._points[-1]

    def _nearest(self, x: float, y: float, low: float, high: float) -> tuple[float, float]:
        best, best_distance = min(low, self.length), math.inf
        for i, (ax, ay) in enumerate(self._points[:-1]):
            if self._s[i + 1] < low or self._s[i] > high:
                continue
            bx, by = self._points[i + 1]
            length = self._s[i + 1] - self._s[i]
            along = ((x - ax) * (bx - ax) + (y - ay) * (by - ay)) / length
            s = min(max(self._s[i] + along, self._s[i], low), self._s[i + 1], high)
            share = (s - self._s[i]) / length
            distance = math.hypot(x - ax - share * (bx - ax), y - ay - share * (by - ay))
            if distance < best_distance:
                best, best_distance = s, distance
        return best, best_distance


def pursue(params: PursuitParams, track: Track, x: float, y: float, heading: float) -> Velocity:
    """The velocity to follow the track with.

    Args:
        params: How.
        track: Where.
        x: Of the robot, in the track's frame [m].
        y: Of the robot, in the track's frame [m].
        heading: Of the robot [rad], positive to the left of the x axis.
    """
    s = track.locate(x, y)
    left = track.length - s
    if left <= params.end_reached:
        return STANDSTILL
    gx, gy = track.at(s + params.lookahead)
    ahead = math.cos(heading) * (gx - x) + math.sin(heading) * (gy - y)
    aside = -math.sin(heading) * (gx - x) + math.cos(heading) * (gy - y)
    if ahead <= 0:  # behind: turn on the spot, to the nearer side
        return Velocity(0.0, math.copysign(params.max_angular, aside))
    curvature = 2 * aside / max(ahead**2 + aside**2, 1e-6)
    linear = min(params.speed, params.end_rate * left)
    if abs(curvature) * linear > params.max_angular:
        linear = params.max_angular / abs(curvature)
    return Velocity(linear, linear * curvature)
