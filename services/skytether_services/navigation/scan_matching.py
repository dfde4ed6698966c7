"""Finding where a laser scan was taken: against a patch of map that other scans made.

`search` looks through a window of poses by the patch's likelihood field, from coarse to fine (Olson, Real-time
correlative scan matching, 2009; bounds as in Hess et al., Real-time loop closure in 2D lidar SLAM, 2016); `refine`
moves points onto lines (Censi, An ICP variant using a point-to-line metric, 2008). Poses are (x [m], y [m], theta
[rad]).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .compiled import compiled
from .patch import CELL, Patch

Floats = NDArray[np.float64]


@compiled
def _score(
    score: NDArray[np.uint8], x0: float, y0: float, cell: float, points: Floats, x: float, y: float, theta: float
) -> float:
    cos, sin = np.cos(theta), np.sin(theta)
    rows, columns = score.shape
    total = 0
    for i in range(points.shape[0]):
        c = int(np.floor((x + cos * points[i, 0] - sin * points[i, 1] - x0) / cell))
        r = int(np.floor((y + sin * points[i, 0] + cos * points[i, 1] - y0) / cell))
        if 0 <= c < columns and 0 <= r < rows:
            total += score[r, c]
    return float(total / (255.0 * points.shape[0]))


def rate(patch: Patch, points: Floats, pose: Floats) -> float:
    """How well a scan fits at a pose: 1 if all points lie on surfaces, 0 if none is near one.

    Args:
        patch: The map.
        points: n by (x, y, ...) in the frame of the laser.
        pose: Of the laser.
    """
    return float(_score(patch.score, *patch.origin, CELL, points, pose[0], pose[1], pose[2]))


def search(
    patch: Patch, points: Floats, guess: Floats, reach_m: float, reach_rad: float, at_least: float = 0.0
) -> tuple[Floats, float]:
    """The pose of the best score within a window, by branch and bound.

    Args:
        patch: The map.
        points: n by (x, y, ...) in the frame of the laser.
        guess: Middle of the window.
        reach_m: The window to each side [m].
        reach_rad: The same for the heading [rad].
        at_least: Poses of a lower score are not looked for.

    Returns:
        The pose, to a cell and to what moves the far points by two, and its score; the guess and 0 if there is none.
    """
    far = float(np.percentile(np.hypot(points[:, 0], points[:, 1]), 80))
    step = 2 * CELL / max(far, 1.0)
    turns = int(np.ceil(reach_rad / step))
    cells = int(np.ceil(reach_m / CELL))
    levels = max(int(np.log2(max(cells, 1))), 0)
    pyramid = _pyramid(patch.score, min(levels, 6))
    best = _branch(pyramid, *patch.origin, CELL, points, guess, turns, step, cells, at_least)
    if best[3] < 0:
        return np.array(guess, dtype=np.float64), 0.0
    return best[:3], float(best[3])


@compiled
def _pyramid(score: NDArray[np.uint8], levels: int) -> NDArray[np.uint8]:
    """Level h holds at (r, c) the largest score of [r, r + 2^h) by [c, c + 2^h), and begins 2^h - 1 cells earlier."""
    rows, columns = score.shape
    margin = 2**levels - 1
    pyramid = np.zeros((levels + 1, rows + margin, columns + margin), np.uint8)
    pyramid[0, margin:, margin:] = score
    for h in range(1, levels + 1):
        step = 2 ** (h - 1)
        for r in range(rows + margin):
            r2 = min(r + step, rows + margin - 1)
            for c in range(columns + margin):
                c2 = min(c + step, columns + margin - 1)
                a = max(pyramid[h - 1, r, c], pyramid[h - 1, r, c2])
                b = max(pyramid[h - 1, r2, c], pyramid[h - 1, r2, c2])
                pyramid[h, r, c] = max(a, b)
    return pyramid


@compiled
def _branch(
    pyramid: NDArray[np.uint8],
    x0: float,
    y0: float,
    cell: float,
    points: Floats,
    guess: Floats,
    turns: int,
    turn: float,
    cells: int,
    at_least: float,
) -> Floats:
    levels = pyramid.shape[0] - 1
    margin = 2**levels - 1
    n = points.shape[0]
    angles = 2 * turns + 1
    us = np.empty((angles, n), np.int32)
    vs = np.empty((angles, n), np.int32)
    for a in range(angles):
        theta = guess[2] + (a - turns) * turn
        cos, sin = np.cos(theta), np.sin(theta)
        for i in range(n):
            us[a, i] = int(np.floor((guess[0] + cos * points[i, 0] - sin * points[i, 1] - x0) / cell)) + margin
            vs[a, i] = int(np.floor((guess[1] + sin * points[i, 0] + cos * points[i, 1] - y0) / cell)) + margin
    width = 2**levels
    across = (2 * cells + width) // width
    bounds = np.empty(angles * across * across)
    for k in range(bounds.size):
        a, rest = k // (across * across), k % (across * across)
        dc, dr = (rest % across) * width - cells, (rest // across) * width - cells
        bounds[k] = _bound(pyramid, levels, us[a], vs[a], dc, dr)
    order = np.argsort(-bounds)
    best = np.array([0.0, 0.0, 0.0, -1.0])
    least = at_least * 255 * n
    stack = np.empty((8 * (levels + 2) + 8, 5))
    for o in range(order.size):
        k = order[o]
        if bounds[k] <= least:
            break
        a, rest = k // (across * across), k % (across * across)
        stack[0, 0] = levels
        stack[0, 1] = (rest % across) * width - cells
        stack[0, 2] = (rest // across) * width - cells
        stack[0, 3] = bounds[k]
        top = 1
        while top > 0:
            top -= 1
            level, dc, dr, bound = int(stack[top, 0]), int(stack[top, 1]), int(stack[top, 2]), stack[top, 3]
            if bound <= least:
                continue
            if level == 0:
                least = bound
                best[0] = guess[0] + dc * cell
                best[1] = guess[1] + dr * cell
                best[2] = guess[2] + (a - turns) * turn
                best[3] = bound / (255.0 * n)
                continue
            half = 2 ** (level - 1)
            first = top
            for q in range(4):
                c, r = dc + (q % 2) * half, dr + (q // 2) * half
                if c > cells or r > cells:
                    continue
                b = _bound(pyramid, level - 1, us[a], vs[a], c, r)
                if b > least:
                    # The most promising last, so that it is looked at first.
                    j = top
                    while j > first and stack[j - 1, 3] > b:
                        stack[j] = stack[j - 1]
                        j -= 1
                    stack[j, 0], stack[j, 1], stack[j, 2], stack[j, 3] = level - 1, c, r, b
                    top += 1
    return best


@compiled
def _bound(
    pyramid: NDArray[np.uint8], level: int, us: NDArray[np.int32], vs: NDArray[np.int32], dc: int, dr: int
) -> float:
    rows, columns = pyramid.shape[1], pyramid.shape[2]
    total = 0
    for i in range(us.size):
        c, r = us[i] + dc, vs[i] + dr
        if 0 <= c < columns and 0 <= r < rows:
            total += pyramid[level, r, c]
    return float(total)


@dataclass(frozen=True)
class Fit:
    """What `refine` found.

    Attributes:
        pose: Of the laser.
        information: 3 by 3, of x, y and theta in the map frame; small along what the surfaces do not hold.
        overlap: Part of the points that lie near a surface which faces as they do.
        residual: Root of their mean square distance from it [m].
    """

    pose: Floats
    information: Floats
    overlap: float
    residual: float


def refine(
    patch: Patch,
    points: Floats,
    guess: Floats,
    prior: Floats | None = None,
    *,
    sigma: float = 0.03,
    iterations: int = 15,
) -> Fit:
    """Move a scan's points onto the surfaces near them (Gauss-Newton).

    Args:
        patch: The map.
        points: n by (x, y, nx, ny) in the frame of the laser.
        guess: Pose to begin at.
        prior: Information, 3 by 3, with which the guess itself holds; None: not at all.
        sigma: Standard deviation of a point about its surface [m]; farther than some of it counts less.
        iterations: At most.
    """
    held = np.zeros((3, 3)) if prior is None else prior
    pose, information, overlap, residual = _gauss_newton(
        patch.nearest, patch.surfaces, *patch.origin, CELL, points, guess, held, sigma, iterations
    )
    return Fit(pose, information, overlap, residual)


@compiled
def _gauss_newton(
    nearest: NDArray[np.int32],
    surfaces: Floats,
    x0: float,
    y0: float,
    cell: float,
    points: Floats,
    guess: Floats,
    prior: Floats,
    sigma: float,
    iterations: int,
) -> tuple[Floats, Floats, float, float]:
    rows, columns = nearest.shape
    pose = guess.copy()
    h = np.zeros((3, 3))
    g = np.zeros(3)
    used, square = 0, 0.0
    for step in range(iterations + 1):
        cos, sin = np.cos(pose[2]), np.sin(pose[2])
        h[:] = prior
        g[:] = 0.0
        off = pose - guess
        for a in range(3):
            for b in range(3):
                g[a] += prior[a, b] * off[b]
        # From wide to narrow: far points pull at first, and hardly at the end.
        width = max(3 * sigma * 0.6**step, 2 * sigma)
        used, square = 0, 0.0
        for i in range(points.shape[0]):
            dx = cos * points[i, 0] - sin * points[i, 1]
            dy = sin * points[i, 0] + cos * points[i, 1]
            x, y = pose[0] + dx, pose[1] + dy
            c, r = int(np.floor((x - x0) / cell)), int(np.floor((y - y0) / cell))
            if not (0 <= c < columns and 0 <= r < rows):
                continue
            k = nearest[r, c]
            if k < 0:
                continue
            nx, ny = surfaces[k, 2], surfaces[k, 3]
            px = cos * points[i, 2] - sin * points[i, 3]
            py = sin * points[i, 2] + cos * points[i, 3]
            if nx * px + ny * py < 0.7:
                continue
            e = nx * (x - surfaces[k, 0]) + ny * (y - surfaces[k, 1])
            # Off the end of its surface a point says little.
            along = abs(-ny * (x - surfaces[k, 0]) + nx * (y - surfaces[k, 1]))
            if along > 0.2:
                continue
            w = 1.0 / (1.0 + (e / width) ** 2)
            w = w * w / (sigma * sigma)
            t = -nx * dy + ny * dx
            h[0, 0] += w * nx * nx
            h[0, 1] += w * nx * ny
            h[0, 2] += w * nx * t
            h[1, 1] += w * ny * ny
            h[1, 2] += w * ny * t
            h[2, 2] += w * t * t
            g[0] += w * nx * e
            g[1] += w * ny * e
            g[2] += w * t * e
            used += 1
            square += min(e * e, 9 * sigma * sigma)
        h[1, 0], h[2, 0], h[2, 1] = h[0, 1], h[0, 2], h[1, 2]
        if step == iterations or used < 5:
            break
        m = h.copy()
        for a in range(3):
            m[a, a] += 1e-3 + 1e-6 * h[a, a]
        move = np.linalg.solve(m, g)
        pose -= move
        if step > 3 and abs(move[0]) + abs(move[1]) < 1e-5 and abs(move[2]) < 1e-5:
            break
    return pose, h, used / max(points.shape[0], 1), np.sqrt(square / max(used, 1))


def scan_points(ranges: NDArray[np.float32], angles: Floats, max_range: float, min_range: float = 0.05) -> Floats:
    """A scan as points with normals.

    Args:
        ranges: Of one scan [m].
        angles: Of its rays [rad].
        max_range: From here on, and for NaN, nothing was seen [m].
        min_range: Nearer than this is dirt on the window [m].

    Returns:
        n by (x, y, nx, ny) in the frame of the laser. Normals look at the laser; (0, 0): the neighbours are no line.
    """
    length = ranges.astype(np.float64)
    return _points(length, length * np.cos(angles), length * np.sin(angles), max_range, min_range)


def with_normals(points: Floats, origin: Floats) -> Floats:
    """Ends of a scan's beams with normals, as `scan_points` makes them.

    Args:
        points: n by (x, y) in the order of the beams; those that met nothing are left out.
        origin: x, y of the laser in the same frame.
    """
    away = points - origin
    result = _points(np.hypot(away[:, 0], away[:, 1]), away[:, 0], away[:, 1], np.inf, 0.0)
    result[:, :2] += origin
    return result


@compiled
def _points(ranges: Floats, xs: Floats, ys: Floats, max_range: float, min_range: float) -> Floats:
    n = ranges.size
    out = np.zeros((n, 4))
    kept = 0
    for i in range(n):
        if not (min_range < ranges[i] < max_range):
            continue
        # The line through the neighbours within reach, on both sides until the surface breaks.
        reach = 0.12 + 0.02 * ranges[i]
        sx, sy, sxx, sxy, syy, m = xs[i], ys[i], xs[i] ** 2, xs[i] * ys[i], ys[i] ** 2, 1
        for side in (-1, 1):
            j = i + side
            lost = 0
            while 0 <= j < n and lost < 2 and abs(j - i) <= 12:
                square = (xs[j] - xs[i]) ** 2 + (ys[j] - ys[i]) ** 2
                if min_range < ranges[j] < max_range and square < reach * reach:
                    sx += xs[j]
                    sy += ys[j]
                    sxx += xs[j] ** 2
                    sxy += xs[j] * ys[j]
                    syy += ys[j] ** 2
                    m += 1
                else:
                    lost += 1
                j += side
        out[kept, 0], out[kept, 1] = xs[i], ys[i]
        if m >= 3:
            cxx, cxy, cyy = sxx / m - (sx / m) ** 2, sxy / m - sx * sy / m**2, syy / m - (sy / m) ** 2
            theta = 0.5 * np.arctan2(2 * cxy, cxx - cyy)
            half = np.hypot((cxx - cyy) / 2, cxy)
            small, large = (cxx + cyy) / 2 - half, (cxx + cyy) / 2 + half
            nx, ny = -np.sin(theta), np.cos(theta)
            if small < 0.1 * large and abs(nx * xs[i] + ny * ys[i]) > 0.1 * ranges[i]:
                sign = -1.0 if nx * xs[i] + ny * ys[i] > 0 else 1.0
                out[kept, 2], out[kept, 3] = sign * nx, sign * ny
        kept += 1
    return out[:kept].copy()


def thin(points: Floats, cell: float) -> Floats:
    """At most one point for each cell of that size [m]: near surfaces have no more say than far ones."""
    kept: Floats = points[_firsts(points, cell)]
    return kept


@compiled
def _firsts(points: Floats, cell: float) -> NDArray[np.bool_]:
    """Which points are the first ones of their cells."""
    n = points.shape[0]
    keys = np.empty(n, np.int64)
    for i in range(n):
        keys[i] = int(np.floor(points[i, 0] / cell)) * 2_000_003 + int(np.floor(points[i, 1] / cell))
    order = np.argsort(keys, kind="mergesort")
    first = np.zeros(n, np.bool_)
    for i in range(n):
        first[order[i]] = i == 0 or keys[order[i]] != keys[order[i - 1]]
    return first


def moved(points: Floats, pose: Floats) -> Floats:
    """Points with normals of a pose's frame in the map's."""
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    turn = np.array([[cos, sin], [-sin, cos]])
    return np.hstack([points[:, :2] @ turn + pose[:2], points[:, 2:4] @ turn])
