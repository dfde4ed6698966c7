"""Zones that people draw on a map, as masks in the format of map_server: keep-out and speed (Nav2's costmap filters).

A mask is an occupancy grid of its own size and resolution: -1 and 0 mean nothing special.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .costmap import LETHAL, UNKNOWN, Costmap, Costs

_FULL = 100


@dataclass(frozen=True, slots=True)
class Mask:
    """A zone's occupancy grid.

    Attributes:
        cells: int8, rows by columns; row 0 has the smallest y. -1, or 0 to 100.
        resolution: Side of a cell [m].
        origin: x, y of the corner of cell (0, 0) [m].
    """

    cells: NDArray[np.int8]
    resolution: float
    origin: tuple[float, float] = (0.0, 0.0)

    def at(self, x: float, y: float) -> int:
        """The value at a point [m]; -1 off the mask."""
        column, row = (x - self.origin[0]) / self.resolution, (y - self.origin[1]) / self.resolution
        rows, columns = self.cells.shape
        return int(self.cells[int(row), int(column)]) if 0 <= row < rows and 0 <= column < columns else -1


def keep_out_costs(mask: Mask, costmap: Costmap) -> Costs:
    """The layer of a keep-out mask on a costmap's cells: 100 is lethal, less costs in proportion, else unknown.

    Combine it before the inflation: then no part of the robot gets into the zone, not only its centre.
    """
    rows, columns = costmap.costs.shape
    x = costmap.origin[0] + (np.arange(columns) + 0.5) * costmap.resolution
    y = costmap.origin[1] + (np.arange(rows) + 0.5) * costmap.resolution
    column = np.floor((x - mask.origin[0]) / mask.resolution).astype(int)
    row = np.floor((y - mask.origin[1]) / mask.resolution).astype(int)
    values = mask.cells[np.ix_(row.clip(0, mask.cells.shape[0] - 1), column.clip(0, mask.cells.shape[1] - 1))]
    off = ((row < 0) | (row >= mask.cells.shape[0]))[:, None] | ((column < 0) | (column >= mask.cells.shape[1]))
    costs = np.rint(values.astype(float) * (LETHAL / _FULL)).clip(0, LETHAL).astype(np.uint8)
    costs[off | (values <= 0)] = UNKNOWN
    return costs


def speed_limit(mask: Mask, x: float, y: float, max_linear: float) -> float:
    """The speed allowed at a point [m/s]: the mask's value is percent of the largest one; 0 and unknown: no limit."""
    value = mask.at(x, y)
    return max_linear * min(value, _FULL) / _FULL if value > 0 and math.isfinite(max_linear) else max_linear
