"""The floor around a sensor as cells on which something stands. Pure.

A cloud has hundreds of thousands of points, and the zones look at each of theirs at every turn. So a point becomes the
four corners of its cell: whatever stands there lies between them, so that nothing is left out and all is larger by a
cell at most. A floor full of things has wider cells instead of more.
"""

from __future__ import annotations

from math import ceil

import numpy as np

from ..geometry.footprint import Points
from .cloud_fields import Floats
from .coverage import Cells

CELL_M = 0.02
"""Width of a cell, as long as not too many of them are needed."""
_SIDE = 1024
"""Cells along the grid at most; `far` beyond 10 m has wider ones."""
MOST = 8_000
"""Corners; the zones look at each of them at every turn."""


class Grid:
    """A square around the sensor.

    Args:
        far: Half of its side [m]; nothing beyond is ever added.
    """

    def __init__(self, far: float) -> None:
        half = min(_SIDE // 2, ceil(far / CELL_M) + 1)
        self._cell = max(CELL_M, far / (half - 1))
        self._half = half
        self._taken = np.zeros((2 * half, 2 * half), dtype=bool)

    def add(self, ahead: Floats, left: Floats) -> None:
        """Put points on it [m]."""
        scale, half, side = np.float32(1 / self._cell), np.float32(self._half), 2 * self._half
        rows, columns = ahead * scale, left * scale
        rows += half
        columns += half
        # Whole numbers up to a million are exact in float32, and quicker there.
        np.floor(rows, out=rows)
        np.floor(columns, out=columns)
        rows *= np.float32(side)
        rows += columns
        self._taken.reshape(-1)[rows.astype(np.intp)] = True

    def corners(self) -> Points:
        """Corners of all cells on which something stands [m]."""
        taken, cell, half = self._taken, self._cell, float(self._half)
        touched = _corners(taken)
        while np.count_nonzero(touched) > MOST:
            taken, cell, half = _coarser(taken), 2 * cell, half / 2
            touched = _corners(taken)
        rows, columns = np.divmod(np.flatnonzero(touched), touched.shape[1])
        return np.column_stack((rows - half, columns - half)) * cell


def _corners(taken: Cells) -> Cells:
    """The grid of corners: those of cells that are taken."""
    rows, columns = taken.shape
    touched = np.zeros((rows + 1, columns + 1), dtype=bool)
    for row in (0, 1):
        for column in (0, 1):
            touched[row : row + rows, column : column + columns] |= taken
    return touched


def _coarser(taken: Cells) -> Cells:
    """The grid with cells of twice the width."""
    side = (taken.shape[0] + 1) // 2
    even = np.zeros((2 * side, 2 * side), dtype=bool)
    even[: taken.shape[0], : taken.shape[1]] = taken
    coarser: Cells = even[::2] | even[1::2]
    return coarser[:, ::2] | coarser[:, 1::2]
