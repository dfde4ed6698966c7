"""Clusters of a laser scan, and what they look like: the first step of finding legs. Pure, one scan at a time.

A cluster is a run of rays whose points lie near each other. Its features are those of the leg-detector literature
(Arras, Mozos, Burgard, ICRA 2007; Leigh, Pineau, Olmedo, Zhang, ICRA 2015): width, girth, circularity, and whether its
ends stand free or are cut off by something nearer.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

GAP = 0.13
"""Points of neighbouring rays further apart than this belong to two clusters, m (Leigh et al. 2015)."""
_LEAST = 3
"""Points of a cluster at the least: fewer have no shape."""
_COARSE = (0.1, 2.2)
"""Where rays are so far apart that fewer than so many meet a leg of such a width [m], two points are a cluster, too."""
_STRIDE = 0.025
"""A girth is measured along points so far apart, m: twice the noise of a usual laser, a quarter of a leg."""
_MOST = 8_000
"""Rays of a scan; of one that has more, each second one is taken, or each third: no leg needs them closer."""
_FURTHEST = 1_000.0
"""No laser of a robot measures further, whatever its limits say, m."""
_FREE = 0.10
"""What lies before a cluster's end by more than this hides the end, m."""


@dataclass(frozen=True, slots=True)
class Rays:
    """The rays of one scan that measured something, in the order of their angles.

    Attributes:
        points: n by (x, y), laser frame [m].
        ranges: [m].
        index: Of each ray in the scan.
        step: Between neighbouring rays of the scan [rad].
    """

    points: Floats
    ranges: Floats
    index: NDArray[np.int64]
    step: float


@dataclass(frozen=True, slots=True)
class Clusters:
    """All clusters of a scan; arrays of one length, in the order of angles.

    Attributes:
        middles: n by (x, y): mean of the points, laser frame [m].
        counts: Points of each.
        widths: Between the first and the last point [m].
        girths: Along points about 2.5 cm apart, from the first to the last [m]: nearer ones would add up the noise.
        radii: Of the circle that fits best [m]; inf for a straight line.
        roundness: Root mean square distance of the points to that circle [m].
        bulges: How far the middle points stand out from the chord towards the laser [m]; below 0: a hollow.
        hidden: n by 2: at this end (lower angle, higher angle) something nearer cuts the cluster off.
        distances: Of the middle from the laser [m].
    """

    middles: Floats
    counts: NDArray[np.int64]
    widths: Floats
    girths: Floats
    radii: Floats
    roundness: Floats
    bulges: Floats
    hidden: NDArray[np.bool_]
    distances: Floats

    def __len__(self) -> int:
        return len(self.counts)


def rays_of(ranges: NDArray[np.floating], first: float, step: float, least: float, most: float) -> Rays:
    """The rays that measured something.

    Args:
        ranges: One scan [m]; NaN, infinity and what is outside the sensor's limits is no measurement.
        first: Angle of the first ray [rad].
        step: Between neighbouring rays [rad]; below 0 for a laser that turns to the right, or hangs upside down.
        least: Ranges below are none [m].
        most: Ranges above are none [m].
    """
    values = np.asarray(ranges, np.float64)
    if not (math.isfinite(first) and math.isfinite(step)):
        values, first, step = values[:0], 0.0, 0.0
    if step < 0:
        values, first, step = values[::-1], first + step * (len(values) - 1), -step
    if len(values) > _MOST:
        each = -(-len(values) // _MOST)
        values, step = values[::each], step * each
    with np.errstate(invalid="ignore"):
        index = np.flatnonzero((values >= max(least, 1e-3)) & (values <= min(most, _FURTHEST)))
    values = values[index]
    angles = first + step * index
    return Rays(np.column_stack([values * np.cos(angles), values * np.sin(angles)]), values, index, step)


def clusters_of(rays: Rays, *, gap: float = GAP, furthest: float = np.inf) -> Clusters:
    """Cut the scan where neighbouring points are far from each other.

    A ray that measured nothing is passed over: black trousers swallow some.

    Args:
        rays: Of the scan.
        gap: Points further apart than this belong to two clusters [m].
        furthest: Clusters whose middle is further from the laser are left out [m].
    """
    points, ranges = rays.points, rays.ranges
    n = len(ranges)
    if n == 0:
        return _none()
    steps = np.hypot(*np.diff(points, axis=0).T)
    cuts = np.flatnonzero(steps > gap) + 1
    begins = np.concatenate([[0], cuts])
    ends = np.concatenate([cuts, [n]])
    counts = ends - begins
    # Of a leg of this width at the range of the first point, so many rays.
    met = _COARSE[0] / np.maximum(ranges[begins] * abs(rays.step), 1e-6)
    keep = counts >= np.where(met < _COARSE[1], 2, _LEAST)
    begins, ends, counts = begins[keep], ends[keep], counts[keep]
    if len(begins) == 0:
        return _none()
    middles = _sums(points, begins, ends) / counts[:, None]
    distances = np.hypot(*middles.T)
    near = distances <= furthest
    begins, ends, counts, middles, distances = (a[near] for a in (begins, ends, counts, middles, distances))
    if len(begins) == 0:
        return _none()
    first, last = points[begins], points[ends - 1]
    chords = last - first
    widths = np.hypot(*chords.T)
    radii, roundness = _circles(points, begins, counts, middles)
    # Positive towards the laser: the chord runs from the lower angle to the higher one, the laser is on its left.
    owner = np.repeat(np.arange(len(begins)), counts)
    place = _expand(begins, counts)
    strides = np.ceil(_STRIDE / np.maximum(distances * abs(rays.step), 1e-6)).astype(np.int64)
    girths = _girths(points[place], owner, place - begins[owner], counts, strides)
    away = points[place] - first[owner]
    side = chords[owner, 0] * away[:, 1] - chords[owner, 1] * away[:, 0]
    bulges = np.bincount(owner, side) / counts / np.maximum(widths, 1e-6)
    hidden = np.zeros((len(begins), 2), bool)
    before, after = begins - 1, ends
    inner = before >= 0
    hidden[inner, 0] = ranges[before[inner]] < ranges[begins[inner]] - _FREE
    inner = after < n
    hidden[inner, 1] = ranges[after[inner]] < ranges[ends[inner] - 1] - _FREE
    return Clusters(middles, counts, widths, girths, radii, roundness, bulges, hidden, distances)


def _none() -> Clusters:
    empty = np.zeros(0)
    return Clusters(
        np.zeros((0, 2)), np.zeros(0, np.int64), empty, empty, empty, empty, empty, np.zeros((0, 2), bool), empty
    )


def _expand(begins: NDArray[np.int64], counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Indices of all points of all clusters, cluster by cluster."""
    ends = np.cumsum(counts)
    places: NDArray[np.int64] = np.arange(ends[-1]) + np.repeat(begins - (ends - counts), counts)
    return places


def _girths(
    points: Floats,
    owner: NDArray[np.int64],
    number: NDArray[np.int64],
    counts: NDArray[np.int64],
    strides: NDArray[np.int64],
) -> Floats:
    """Way along each cluster's points, of which each stride's first one counts, and the last one."""
    kept = (number % strides[owner] == 0) | (number == counts[owner] - 1)
    points, owner = points[kept], owner[kept]
    same = owner[1:] == owner[:-1]
    steps = np.hypot(*np.diff(points, axis=0).T)
    found: Floats = np.bincount(owner[1:][same], steps[same], minlength=len(counts)).astype(np.float64)
    return found


def _sums(values: Floats, begins: NDArray[np.int64], ends: NDArray[np.int64]) -> Floats:
    """Sum over each run of rows."""
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    found: Floats = total[ends] - total[begins]
    return found


def _circles(
    points: Floats,
    begins: NDArray[np.int64],
    counts: NDArray[np.int64],
    middles: Floats,
) -> tuple[Floats, Floats]:
    """Radius of the circle through each cluster's points, and how far they are from it (Kasa's least squares)."""
    owner = np.repeat(np.arange(len(begins)), counts)
    place = _expand(begins, counts)
    x, y = (points[place] - middles[owner]).T
    square = x * x + y * y
    columns = np.column_stack([x * x, x * y, y * y, x * square, y * square, square])
    last = np.cumsum(counts)
    xx, xy, yy, xz, yz, zz = _sums(columns, last - counts, last).T
    # With the points' mean at 0: [xx xy; xy yy] (a, b) = (xz, yz) / 2, and r^2 = a^2 + b^2 + mean(x^2 + y^2).
    determinant = xx * yy - xy * xy
    flat = determinant <= 1e-9 * (xx + yy) ** 2 + 1e-15
    safe = np.where(flat, 1.0, determinant)
    a = np.where(flat, 0.0, (yy * xz - xy * yz) / (2 * safe))
    b = np.where(flat, 0.0, (xx * yz - xy * xz) / (2 * safe))
    radii = np.where(flat, np.inf, np.sqrt(a * a + b * b + zz / counts))
    off = np.hypot(x - a[owner], y - b[owner]) - np.where(flat, 0.0, radii)[owner]
    spread = np.sqrt(np.bincount(owner, off * off) / counts)
    # A straight line is off by its points' distance from it, which is the smaller half axis of their ellipse.
    line = np.sqrt(np.maximum((xx + yy) / 2 - np.sqrt(((xx - yy) / 2) ** 2 + xy * xy), 0.0) / counts)
    return radii, np.where(flat, line, spread)
