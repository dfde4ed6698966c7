"""The robot's outline on the floor, and what its way sweeps over. Pure geometry, exact, many points at once.

Everything is in the base frame: metres, x forward, y left, the origin where the velocity command applies. Outlines are
convex: of others the convex hull is taken, which is never too small.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from math import cos, hypot, inf, isfinite, pi, sin, tau

import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float64]
"""Shape (n, 2): x and y [m]."""

_CIRCLE_SIDES = 16
"""Of the polygon around a circle: 2 % larger than the circle at its corners."""
_STRAIGHT = 1e-4
"""Curvature [1/m] that counts as none: 1 mm beside the way after 5 m."""
_EDGE = 1e-9
"""Distance [m] from the edge that still counts as on it, against rounding."""
_ROUNDED = 2e-6
"""The same for edges of outlines that `polygon` made."""


@dataclass(frozen=True, eq=False)
class Footprint:
    """A convex polygon.

    Attributes:
        vertices: Counter-clockwise, shape (n, 2), n >= 3.
    """

    vertices: Points

    @cached_property
    def radius(self) -> float:
        """Distance of the outermost corner from the origin [m]."""
        return float(np.hypot(self.vertices[:, 0], self.vertices[:, 1]).max())

    @cached_property
    def _normals(self) -> Points:
        """Outward unit normals of the edges."""
        along = np.roll(self.vertices, -1, axis=0) - self.vertices
        return np.column_stack((along[:, 1], -along[:, 0])) / np.hypot(along[:, 0], along[:, 1])[:, None]

    @cached_property
    def _offsets(self) -> NDArray[np.float64]:
        """Distance of each edge's line from the origin along its normal."""
        offsets: NDArray[np.float64] = np.einsum("ij,ij->i", self._normals, self.vertices)
        return offsets

    def inflated(self, margin: float) -> Footprint:
        """The outline with room of at least ``margin`` [m] around; at corners up to 8 % more."""
        if margin == 0:
            return self
        corners, ways = _sums(self.vertices, _OCTAGON)
        return Footprint(corners + margin * ways)

    def outside(self, points: Points) -> NDArray[np.float64]:
        """How far each point is outside of the nearest edge's line [m]: negative inside, where it is the depth."""
        beyond: NDArray[np.float64] = (points @ self._normals.T - self._offsets).max(axis=1)
        return beyond

    def ways_out(self, origin: tuple[float, float], bearings: NDArray[np.float64]) -> NDArray[np.float64]:
        """How far it is from a point within the outline to its edge [m], by direction [rad]; 0 from outside."""
        inside = np.maximum(self._offsets - self._normals @ np.asarray(origin), 0.0)
        if not (self.outside(np.array([origin])) <= 0).all():
            return np.zeros(len(bearings))
        rates = np.column_stack((np.cos(bearings), np.sin(bearings))) @ self._normals.T
        with np.errstate(divide="ignore", invalid="ignore"):
            ways = np.where(rates > 0, inside / rates, inf)
        nearest: NDArray[np.float64] = ways.min(axis=1)
        return nearest

    def inner_shares(self, starts: Points, along: Points) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """From which share of each line to which it is inside, by more than rounding; never: the second is below.

        Args:
            starts: Where the lines begin, shape (n, 2).
            along: From there to their ends, shape (n, 2).
        """
        beyond = starts @ self._normals.T - self._offsets + _ROUNDED
        enter, leave = _passage(beyond, along @ self._normals.T)
        return np.maximum(enter, 0.0), np.minimum(leave, 1.0)

    def time_to_contact(self, points: Points, linear: float, angular: float) -> float:
        """When the first of the points, which stand still, is touched if the robot goes on like that.

        Args:
            points: Shape (n, 2).
            linear: Forward velocity [m/s].
            angular: Rate to the left [rad/s].

        Returns:
            Seconds, 0 or more; inf for never.
        """
        return float(self.times_to_contact(points, linear, angular).min(initial=inf))

    def times_to_contact(self, points: Points, linear: float, angular: float) -> NDArray[np.float64]:
        """The same for each of the points alone, shape (n,).

        A point on the edge or inside is touched at once if the motion brings it deeper, else it is not looked at: from
        such a place the robot may go, but not on.
        """
        times = np.full(len(points), inf)
        if not len(points) or (linear == 0 and angular == 0):
            return times
        beyond = points @ self._normals.T - self._offsets
        inside = beyond.max(axis=1) <= _EDGE
        outside = ~inside
        if inside.any():
            times[inside] = np.where(self._deeper(points[inside], beyond[inside], linear, angular), 0.0, inf)
        if is_straight(linear, angular):
            times[outside] = self._straight(beyond[outside], linear)
        elif outside.any():
            times[outside] = self._arc(points[outside], linear, angular)
        return times

    def _deeper(self, points: Points, beyond: NDArray[np.float64], linear: float, angular: float) -> NDArray[np.bool_]:
        """Which of these points, seen from the robot, move in through the edge that they are nearest to."""
        normals = self._normals[beyond.argmax(axis=1)]
        seen = np.column_stack((angular * points[:, 1] - linear, -angular * points[:, 0]))
        deeper: NDArray[np.bool_] = np.einsum("ij,ij->i", normals, seen) < -_EDGE
        return deeper

    def _straight(self, beyond: NDArray[np.float64], linear: float) -> NDArray[np.float64]:
        """Seen from the robot the points come along x: clip their way at the line of each edge."""
        enter, leave = _passage(beyond, np.broadcast_to(-linear * self._normals[:, 0], beyond.shape))
        return np.where((enter <= leave) & (enter >= 0), enter, inf)

    def _arc(self, points: Points, linear: float, angular: float) -> NDArray[np.float64]:
        """Seen from the robot the points go on circles about the centre of its turn: cut them with each edge."""
        centre = np.array((0.0, linear / angular))
        rays = points - centre
        start = self.vertices - centre
        along = np.roll(self.vertices, -1, axis=0) - self.vertices
        a = np.einsum("ij,ij->i", along, along)
        half_b = np.einsum("ij,ij->i", start, along)
        c = np.einsum("ij,ij->i", start, start) - np.einsum("ij,ij->i", rays, rays)[:, None]
        root = half_b**2 - a * c
        cut = root >= 0
        root = np.sqrt(np.where(cut, root, 0.0))
        bearing = np.arctan2(rays[:, 1], rays[:, 0])[:, None]
        first = np.full(len(points), inf)
        for sign in (-1.0, 1.0):
            share = (sign * root - half_b) / a
            x, y = start[:, 0] + share * along[:, 0], start[:, 1] + share * along[:, 1]
            turn = ((bearing - np.arctan2(y, x)) * np.sign(angular)) % tau
            hit = cut & (share >= -_EDGE) & (share <= 1 + _EDGE)
            first = np.minimum(first, np.where(hit, turn, inf).min(axis=1))
        with np.errstate(over="ignore"):
            return first / abs(angular)


class Outlines:
    """An outline with more and less room around it, quickly: which corners meet never changes.

    Args:
        outline: Without room.
        margin: The least room [m], above 0.
    """

    def __init__(self, outline: Footprint, margin: float) -> None:
        self.least = outline.inflated(margin)
        self._margin = margin
        self._corners, self._ways = _sums(outline.vertices, _OCTAGON)

    def __call__(self, more: float) -> Footprint:
        """With so much more room [m], 0 or above."""
        return self.least if more <= 0 else Footprint(self._corners + (self._margin + more) * self._ways)


def is_straight(linear: float, angular: float) -> bool:
    """Whether a curve is so wide that it counts as none."""
    return abs(angular) <= _STRAIGHT * abs(linear)


def polygon(corners: Iterable[tuple[float, float]]) -> Footprint:
    """The convex hull of corners in any order [m] (Andrew's monotone chain), to a micrometre.

    Raises:
        ValueError: A number is not finite, or there is no area.
    """
    # Corners that rounding alone holds apart have edges of no direction.
    points = sorted({(round(float(x), 6), round(float(y), 6)) for x, y in corners})
    if not all(isfinite(x) and isfinite(y) for x, y in points):
        raise ValueError("footprint: corners must be finite numbers")
    lower, upper = _chain(points), _chain(points[::-1])
    hull = lower[:-1] + upper[:-1]
    if len(hull) < 3:
        raise ValueError("footprint: a polygon needs three corners that are not on one line")
    return Footprint(np.array(hull))


def circle(radius: float) -> Footprint:
    """A polygon around a circle about the origin.

    Raises:
        ValueError: The radius is not above 0 and finite.
    """
    if not 0 < radius < inf:
        raise ValueError(f"footprint: radius must be above 0 and finite, not {radius}")
    return polygon(_regular(radius, _CIRCLE_SIDES))


def _regular(radius: float, sides: int) -> list[tuple[float, float]]:
    """A regular polygon around a circle."""
    outer = radius / cos(pi / sides)
    return [(outer * cos(tau * (i + 0.5) / sides), outer * sin(tau * (i + 0.5) / sides)) for i in range(sides)]


_OCTAGON: Points = np.array(_regular(1.0, 8))


def _sums(one: Points, two: Points) -> tuple[Points, Points]:
    """Which corners of two convex polygons (counter-clockwise) meet in a corner of their Minkowski sum, in its order.

    Each corner of the sum lies between two edges that follow each other when all edges are sorted by direction. So the
    pairs are the same however large either polygon is.
    """
    starts = [int(np.lexsort((each[:, 0], each[:, 1]))[0]) for each in (one, two)]
    edges = []
    for which, (each, start) in enumerate(zip((one, two), starts, strict=True)):
        along = np.roll(each, -1, axis=0) - each
        turned = np.roll(np.arctan2(along[:, 1], along[:, 0]) % tau, -start)
        edges += [(float(direction), which) for direction in turned]
    edges.sort()
    at, pairs = starts[:], []
    for (direction, which), (following, _) in zip(edges, [*edges[1:], (inf, 0)], strict=True):
        at[which] += 1
        if following - direction > _EDGE:
            pairs.append((at[0] % len(one), at[1] % len(two)))
    first, second = zip(*pairs, strict=True)
    return one[list(first)], two[list(second)]


def _passage(beyond: NDArray[np.float64], rate: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """When points that come at steady rates are past the line of every edge, and when they leave again.

    Args:
        beyond: How far each point is outside of each edge's line, shape (points, edges).
        rate: How that grows, the same shape.
    """
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        crossing = -beyond / rate
    enter = np.where(rate < 0, crossing, -inf).max(axis=1)
    leave = np.where(rate > 0, crossing, inf).min(axis=1)
    beside = ((rate == 0) & (beyond > 0)).any(axis=1)
    return np.where(beside, inf, enter), np.where(beside, -inf, leave)


def _chain(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    chain: list[tuple[float, float]] = []
    for p in points:
        while len(chain) > 1 and not _left(chain[-2], chain[-1], p):
            chain.pop()
        chain.append(p)
    return chain


def _left(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> bool:
    """Whether c is left of the way from a to b, by more than rounding."""
    turn = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    return turn > 1e-12 * max(1.0, hypot(c[0] - a[0], c[1] - a[1]))
