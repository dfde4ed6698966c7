"""The path of the follow-in-front experiment: a lemniscate of Bernoulli on the floor. Pure.

The thesis (section 5.5.2) names "a parameter a = 2.5 m" and not which of the two that are called so. Here a is half of
the distance between the foci, ``(x^2 + y^2)^2 = 2 a^2 (x^2 - y^2)``: one round is 18.5 m, and the thesis's times by its
mean speeds (60.1 s at 0.33 m/s, 51.2 s at 0.37 m/s, 53.9 s at 0.33 m/s) make 18 to 20 m. With a as half of the width
it would be 13.1 m.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from skytether.lab.trail import Pose

THESIS_A = 2.5
"""m."""
_POINTS = 8000
"""Of one round: 2.3 mm apart."""
_REACH = 0.5
"""`Lap` looks for the robot no further ahead than this, m: the curve crosses itself."""


class Lemniscate:
    """Its middle is the origin, its length lies along x.

    A round begins at the middle with a heading of -45 degrees: it goes around the right half, to the left, and then
    around the left half, to the right.

    Attributes:
        a: Half of the distance between the foci [m].
        half_width: From the middle to the right end [m].
        length: Of one round [m].
        points: Along the round, the last one being the first, shape (n, 2) [m].
    """

    def __init__(self, a: float = THESIS_A) -> None:
        """Raises ValueError for an a that is not above 0."""
        if not 0 < a < math.inf:
            raise ValueError(f"lemniscate: a must be above 0 m, not {a}")
        self.a = a
        self.half_width = a * math.sqrt(2)
        self._t = np.linspace(-math.pi / 2, 3 * math.pi / 2, _POINTS + 1)
        cos, sin = np.cos(self._t), np.sin(self._t)
        self.points: NDArray[np.float64] = self.half_width * np.column_stack([cos, sin * cos]) / (1 + sin**2)[:, None]
        self._s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(self.points, axis=0).T))])
        self.length = float(self._s[-1])

    def at_parameter(self, t: float) -> Pose:
        """Where ``x = w cos t / (1 + sin^2 t)``, ``y = x sin t`` is, w being `half_width`.

        A round is t from -90 to 270 degrees.
        """
        cos, sin = math.cos(t), math.sin(t)
        x = self.half_width * cos / (1 + sin**2)
        # Derivatives by t, both times the same positive factor.
        along, across = -sin * (3 - sin**2), 1 - 3 * sin**2
        return Pose(x, x * sin, math.atan2(across, along))

    def at(self, s: float) -> Pose:
        """Where an arc length from the beginning [m] is; it goes round and round."""
        return self.at_parameter(float(np.interp(s % self.length, self._s, self._t)))

    def distances(self, path: Sequence[Sequence[float]] | NDArray[np.float64]) -> NDArray[np.float64]:
        """From each point of a path, shape (n, 2) [m], to the nearest point of the curve [m]."""
        points = np.asarray(path, np.float64).reshape(-1, 2)
        return np.array([math.sqrt(float(_squares(self.points, x, y).min())) for x, y in points])

    def nearest(self, x: float, y: float, low: float, high: float) -> float:
        """Arc length between these two [m] whose point is nearest to (x, y) [m]."""
        first = min(int(np.searchsorted(self._s, low)), _POINTS)
        last = max(int(np.searchsorted(self._s, high, "right")), first + 1)
        return float(self._s[first + int(np.argmin(_squares(self.points[first:last], x, y)))])


class Lap:
    """How far a robot has come on its round, in order: it only grows, and skips nothing.

    Attributes:
        s: Arc length [m].
    """

    def __init__(self, curve: Lemniscate, *, tolerance: float = 0.05) -> None:
        """The round is over this much [m] before its end."""
        self._curve, self._end = curve, curve.length - tolerance
        self.s = 0.0

    @property
    def done(self) -> bool:
        """Whether the round is over."""
        return self.s >= self._end

    def update(self, x: float, y: float) -> float:
        """Take where the robot is [m]; returns `s`."""
        self.s = max(self.s, self._curve.nearest(x, y, self.s, self.s + _REACH))
        return self.s


def _squares(points: NDArray[np.float64], x: float, y: float) -> NDArray[np.float64]:
    found: NDArray[np.float64] = (points[:, 0] - x) ** 2 + (points[:, 1] - y) ** 2
    return found
