"""Costmaps as ROS's costmap_2d has them: what is in the way, and how near it is.

A cell costs 0 (free) to 254 (lethal: something is there); 253 is inscribed: a robot with its centre there collides;
255 is unknown. Layers are arrays of the same size: the static map, marks of sensors (`obstacles.py`), zones
(`zones.py`); `combine` puts them together, `inflate` adds what lies within the robot's reach.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from skytether.service import param

Costs = NDArray[np.uint8]

FREE = 0
INSCRIBED = 253
LETHAL = 254
UNKNOWN = 255


@dataclass(frozen=True, slots=True)
class Costmap:
    """Costs over a part of the plane.

    Attributes:
        costs: uint8, rows by columns; row 0 has the smallest y.
        resolution: Side of a cell [m].
        origin: x, y of the corner of cell (0, 0) [m]; rows run along x of the same frame, without a turn.
    """

    costs: Costs
    resolution: float
    origin: tuple[float, float] = (0.0, 0.0)

    def cell(self, x: float, y: float) -> tuple[int, int] | None:
        """Row and column of a point [m]; None off the map, and for what is not finite."""
        column, row = (x - self.origin[0]) / self.resolution, (y - self.origin[1]) / self.resolution
        rows, columns = self.costs.shape
        # Comparisons with NaN are false, so it ends here as well.
        return (int(row), int(column)) if 0 <= row < rows and 0 <= column < columns else None

    def at(self, x: float, y: float) -> int:
        """Cost at a point [m]; off the map it is unknown."""
        cell = self.cell(x, y)
        return UNKNOWN if cell is None else int(self.costs[cell])

    def center(self, row: int, column: int) -> tuple[float, float]:
        """x, y of a cell's middle [m]."""
        return (self.origin[0] + (column + 0.5) * self.resolution, self.origin[1] + (row + 0.5) * self.resolution)


@dataclass(frozen=True)
class InflationParams:
    """How costs fall off around what is in the way."""

    radius: float = param(0.6, unit="m", gt=0, doc="nothing is inflated beyond; at least the circumscribed radius")
    decay: float = param(
        4.0, unit="1/m", gt=0, doc="how fast costs fall with the distance (costmap_2d: cost_scaling_factor)"
    )


def static_costs(cells: NDArray[np.int8], *, lethal_from: int = 65) -> Costs:
    """Costs of an occupancy grid: lethal from a probability on [percent], free below, unknown where it is -1."""
    costs = np.where(cells >= lethal_from, np.uint8(LETHAL), np.uint8(FREE))
    costs[cells < 0] = UNKNOWN
    return costs


def combine(below: Costs, above: Costs) -> Costs:
    """The larger of two layers, cell by cell; what only one of them knows is as that one says (updateWithMax)."""
    # One more wraps unknown to the smallest value, and keeps all others in order.
    one = np.uint8(1)
    return cast(Costs, np.maximum(below + one, above + one) - one)


def window(whole: Costmap, x: float, y: float, width: float, height: float) -> Costmap:
    """A copy of the part around a point, on the same cells; what lies off the map is unknown.

    Args:
        whole: The map.
        x: Of the middle [m].
        y: Likewise.
        width: Along x [m].
        height: Along y [m].
    """
    columns, rows = round(width / whole.resolution), round(height / whole.resolution)
    column = math.floor((x - whole.origin[0]) / whole.resolution) - columns // 2
    row = math.floor((y - whole.origin[1]) / whole.resolution) - rows // 2
    costs = np.full((rows, columns), UNKNOWN, dtype=np.uint8)
    r0, r1 = max(row, 0), min(row + rows, whole.costs.shape[0])
    c0, c1 = max(column, 0), min(column + columns, whole.costs.shape[1])
    if r0 < r1 and c0 < c1:
        costs[r0 - row : r1 - row, c0 - column : c1 - column] = whole.costs[r0:r1, c0:c1]
    corner = (whole.origin[0] + column * whole.resolution, whole.origin[1] + row * whole.resolution)
    return Costmap(costs, whole.resolution, corner)


def shifted(costs: Costs, rows: int, columns: int) -> Costs:
    """The layer of a window that moved by so many cells towards larger y and x; what came into it is unknown."""
    result = np.full_like(costs, UNKNOWN)
    height, width = costs.shape
    if abs(rows) < height and abs(columns) < width:
        to_r, to_c = max(-rows, 0), max(-columns, 0)
        from_r, from_c = max(rows, 0), max(columns, 0)
        h, w = height - abs(rows), width - abs(columns)
        result[to_r : to_r + h, to_c : to_c + w] = costs[from_r : from_r + h, from_c : from_c + w]
    return result


def cost_of_distance(distance: float, inscribed: float, decay: float) -> int:
    """Cost of a cell so far [m] from the nearest lethal one (costmap_2d, InflationLayer::computeCost)."""
    if distance == 0:
        return LETHAL
    if distance <= inscribed:
        return INSCRIBED
    return int((INSCRIBED - 1) * math.exp(-decay * (distance - inscribed)))


def inflation_table(resolution: float, inscribed: float, params: InflationParams) -> Costs:
    """Costs by the squared distance in cells, from 0 to the inflation radius; 0 in the last entry, for all beyond."""
    reach = int((params.radius / resolution) ** 2 + 1e-9)
    costs = [cost_of_distance(math.sqrt(n) * resolution, inscribed, params.decay) for n in range(reach + 1)]
    return np.array([*costs, FREE], dtype=np.uint8)


def inflate(costs: Costs, table: Costs) -> Costs:
    """Costs around what is lethal, by exact distances between cells.

    What is unknown stays so where the robot's centre may be (costmap_2d with inflate_unknown off).

    Args:
        costs: Rows by columns.
        table: Of ``inflation_table``.
    """
    free = (costs != LETHAL).view(np.uint8)
    if free.all():
        return costs.copy()
    distances = cast(
        NDArray[np.float32], cv2.distanceTransform(free, cv2.DIST_L2, cv2.DIST_MASK_PRECISE, dstType=cv2.CV_32F)
    )
    # Squared distances between cells are whole numbers; a float32 is exact enough to find them again.
    np.multiply(distances, distances, out=distances)
    np.minimum(distances, np.float32(len(table) - 1), out=distances)
    distances += np.float32(0.5)
    inflated = table[distances.astype(np.intp)]
    result = np.maximum(costs, inflated)
    result[(costs == UNKNOWN) & (inflated >= INSCRIBED)] = INSCRIBED
    return result
