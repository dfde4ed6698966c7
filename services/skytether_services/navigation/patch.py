"""A patch of map that scans made, for other scans to be matched with.

Around each surface it knows how near, and which, the nearest piece of surface is.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from .compiled import compiled

Floats = NDArray[np.float64]

CELL = 0.05
"""Side of a cell [m]."""
REACH = 8
"""Cells around a surface that know it: 0.4 m."""
SIGMA = 0.1
"""Of the likelihood field [m]: what a pose a step of the search away still scores."""
_MERGE = 2
"""Cells that make one piece of surface, along each axis."""
_MAX_CELLS = 4_000_000
"""Of a patch: 100 m by 100 m."""


@dataclass(frozen=True)
class Patch:
    """A piece of map for matching.

    Attributes:
        origin: Corner of cell (0, 0) [m].
        squares: Rows by columns, float32: squared distance to the nearest surface [cells²], 1e9 where none is near.
        nearest: Rows by columns, int32: number of the nearest surface, -1 where none is near.
        surfaces: Number by (x, y, nx, ny): mean position and unit normal (0, 0 without one).
    """

    origin: tuple[float, float]
    squares: NDArray[np.float32]
    nearest: NDArray[np.int32]
    surfaces: Floats

    @cached_property
    def score(self) -> NDArray[np.uint8]:
        """Rows by columns: 255 on a surface, exp(-d² / 2 SIGMA²) of that at d. Made when it is asked for first."""
        # Where a robot is followed scan by scan it is hardly ever asked for.
        return _likelihood(self.squares, CELL, SIGMA)


class PatchMemory:
    """Room for one patch at a time: to get new memory from the system takes longer than to fill it."""

    def __init__(self) -> None:
        self._squares = np.empty(0, np.float32)
        self._nearest = np.empty(0, np.int32)

    def room(self, rows: int, columns: int) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
        """For ``squares`` and ``nearest``; what the patch before it had is overwritten."""
        size = rows * columns
        if size > self._squares.size:
            # With some room to spare: a patch seldom has the size of the one before it.
            self._squares, self._nearest = np.empty(size * 3 // 2, np.float32), np.empty(size * 3 // 2, np.int32)
        return self._squares[:size].reshape(rows, columns), self._nearest[:size].reshape(rows, columns)


def make_patch(points: Floats, reach: int = REACH, memory: PatchMemory | None = None) -> Patch:
    """A patch of points with normals.

    Args:
        points: n by (x, y, nx, ny) in the map frame; a normal of (0, 0) is not known.
        reach: Cells around a surface that know it.
        memory: The patch is made in it, and is good until the next one is; None: in memory of its own.
    """
    margin = (reach + 1) * CELL
    bounds = _bounds(points)
    low, high = bounds[0] - margin, bounds[1] + margin
    columns, rows = (np.ceil((high - low) / CELL).astype(int) + 1).tolist()
    if rows * columns > _MAX_CELLS:
        middle = np.median(points[:, :2], axis=0)
        half = np.sqrt(_MAX_CELLS) * CELL / 2 - margin
        return make_patch(points[(np.abs(points[:, :2] - middle) < half).all(axis=1)], reach, memory)
    squares, nearest = (memory or PatchMemory()).room(rows, columns)
    surfaces = _fill(squares, nearest, points, low[0], low[1], CELL, reach, _MERGE)
    return Patch((float(low[0]), float(low[1])), squares, nearest, surfaces)


@compiled
def _bounds(points: Floats) -> Floats:
    """Least and largest x and y, 2 by 2."""
    bounds = np.array([[np.inf, np.inf], [-np.inf, -np.inf]])
    for i in range(points.shape[0]):
        for axis in range(2):
            bounds[0, axis] = min(bounds[0, axis], points[i, axis])
            bounds[1, axis] = max(bounds[1, axis], points[i, axis])
    return bounds


@compiled
def _stamp(
    squares: NDArray[np.float32],
    nearest: NDArray[np.int32],
    number: np.int32,
    u: float,
    v: float,
    reach: int,
    across: NDArray[np.float32],
) -> None:
    """Tell the cells around (u, v), in cells, of a surface there, where none is nearer to them."""
    rows, columns = squares.shape
    middle, most = int(u + 0.5), np.float32(reach * reach)
    first, end = max(middle - reach, 0), min(middle + reach + 1, columns)
    for column in range(first, end):
        across[column - first] = (column - u) ** 2
    beside = across[: end - first]
    middle = int(v + 0.5)
    for row in range(max(middle - reach, 0), min(middle + reach + 1, rows)):
        down = np.float32((row - v) ** 2)
        square_of, number_of = squares[row, first:end], nearest[row, first:end]
        for i in range(beside.size):
            # Without a branch, so that several cells are done at once.
            square = beside[i] + down
            nearer = (square < square_of[i]) & (square <= most)
            square_of[i] = square if nearer else square_of[i]
            number_of[i] = number if nearer else number_of[i]


@compiled
def _fill(
    squares: NDArray[np.float32],
    nearest: NDArray[np.int32],
    points: Floats,
    x0: float,
    y0: float,
    cell: float,
    reach: int,
    merge: int,
) -> Floats:
    rows, columns = squares.shape
    number = np.full((rows // merge + 1, columns // merge + 1), -1, np.int32)
    piece = np.empty(points.shape[0], np.int32)
    count = 0
    for i in range(points.shape[0]):
        c = int((points[i, 0] - x0) / (cell * merge))
        r = int((points[i, 1] - y0) / (cell * merge))
        if number[r, c] < 0:
            number[r, c] = count
            count += 1
        piece[i] = number[r, c]
    sums = np.zeros((count, 5))
    for i in range(points.shape[0]):
        k = piece[i]
        # Both sides of a thin wall are in a cell: keep the side seen first.
        if sums[k, 2] * points[i, 2] + sums[k, 3] * points[i, 3] < 0:
            continue
        sums[k, 0] += points[i, 0]
        sums[k, 1] += points[i, 1]
        sums[k, 2] += points[i, 2]
        sums[k, 3] += points[i, 3]
        sums[k, 4] += 1
    surfaces = np.zeros((count, 4))
    squares[:] = np.float32(1e9)
    nearest[:] = -1
    across = np.empty(2 * reach + 1, np.float32)
    for k in range(count):
        x, y = sums[k, 0] / sums[k, 4], sums[k, 1] / sums[k, 4]
        surfaces[k, 0], surfaces[k, 1] = x, y
        norm = np.sqrt(sums[k, 2] ** 2 + sums[k, 3] ** 2)
        if norm > 0.5 * sums[k, 4]:
            surfaces[k, 2], surfaces[k, 3] = sums[k, 2] / norm, sums[k, 3] / norm
        _stamp(squares, nearest, np.int32(k), (x - x0) / cell - 0.5, (y - y0) / cell - 0.5, reach, across)
    return surfaces


@compiled
def _likelihood(squares: NDArray[np.float32], cell: float, sigma: float) -> NDArray[np.uint8]:
    # Farther than four standard deviations nothing is left of 255.
    table = np.empty(int(4 * (4 * sigma / cell) ** 2) + 1, np.uint8)
    for i in range(table.size):
        table[i] = np.uint8(255 * np.exp(-(i / 4) * cell * cell / (2 * sigma * sigma)))
    rows, columns = squares.shape
    score = np.zeros((rows, columns), np.uint8)
    for r in range(rows):
        for c in range(columns):
            quarter = squares[r, c] * 4
            if quarter < table.size:
                score[r, c] = table[int(quarter)]
    return score
