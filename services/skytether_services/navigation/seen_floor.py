"""The floor that a robot saw as free while it drove: what a map shows there speaks for or against a pose.

Beams compare ends; a pose in a part of the map that is hardly known contradicts few of them. The floor that they
crossed has to be floor of the map, too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from skytether_services.navigation.compiled import compiled
from skytether_services.navigation.likelihood_field import LikelihoodField, to_cell_poses

Array = NDArray[np.float64]

_CELL = 0.1
"""Side of the cells in which the floor is gathered [m]."""
_CLEAR = 2
"""Cells this near to something are left out: there the map's walls are."""
_REACH = 15.0
"""Beams are followed so far [m]."""
_MOST = 2000
"""Cells that are compared: more say no more."""
_WALL, _UNKNOWN = 12.0, 0.4
"""What is said against a pose where all of the floor is wall of the map, or not known to it: log-likelihood of a beam.

From the right pose 0.3 % of the floor is wall, from a wrong one 4 %; unknown are 10 and 40 %. A robot that asks where
it is on a map mostly drives on it.
"""


@compiled
def _cross(
    starts: Array,
    ends: Array,
    low: Array,
    cell: float,
    reach: float,
    crossed: NDArray[np.int32],
    met: NDArray[np.int32],
) -> None:
    for beam in range(ends.shape[0]):
        dx, dy = ends[beam, 0] - starts[beam, 0], ends[beam, 1] - starts[beam, 1]
        length = math.hypot(dx, dy)
        steps = int(min(length - 2.5 * cell, reach) / cell)
        for step in range(steps):
            share = step * cell / length
            column = int((starts[beam, 0] + share * dx - low[0]) / cell)
            row = int((starts[beam, 1] + share * dy - low[1]) / cell)
            crossed[row, column] += 1
        met[int((ends[beam, 1] - low[1]) / cell), int((ends[beam, 0] - low[0]) / cell)] += 1


def seen_floor(starts: Array, ends: Array) -> Array:
    """Middles of the cells that beams crossed, none of them near what beams mostly ended at; n by 2 [m].

    Args:
        starts: m by 2: where each beam starts, in the robot's frame [m].
        ends: m by 2: where it ends.
    """
    if len(ends) == 0:
        return np.zeros((0, 2))
    low = np.minimum(starts.min(axis=0), ends.min(axis=0)) - 1.0
    high = np.maximum(starts.max(axis=0), ends.max(axis=0)) + 1.0
    columns, rows = np.ceil((high - low) / _CELL).astype(int).tolist()
    crossed, met = np.zeros((rows, columns), np.int32), np.zeros((rows, columns), np.int32)
    _cross(np.ascontiguousarray(starts), np.ascontiguousarray(ends), low, _CELL, _REACH, crossed, met)
    things = ((met > 0) & (2 * met > crossed)).astype(np.uint8)
    side = 2 * _CLEAR + 1
    near = cv2.dilate(things, np.ones((side, side), np.uint8))
    row, column = np.nonzero((crossed > 0) & (near == 0))
    if len(row) > _MOST:
        kept = np.linspace(0, len(row) - 1, _MOST).astype(np.int64)
        row, column = row[kept], column[kept]
    middles: Array = np.column_stack((column + 0.5, row + 0.5)) * _CELL + low
    return middles


@compiled
def _count(cells: NDArray[np.int8], pose: Array, points: Array) -> tuple[int, int]:
    rows, columns = cells.shape
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    walls, unknown = 0, 0
    for index in range(points.shape[0]):
        column = math.floor(pose[0] + cos * points[index, 0] - sin * points[index, 1])
        row = math.floor(pose[1] + sin * points[index, 0] + cos * points[index, 1])
        if not (0 <= row < rows and 0 <= column < columns) or cells[row, column] < 0:
            unknown += 1
        elif cells[row, column] >= 50:
            walls += 1
    return walls, unknown


@dataclass(frozen=True)
class Floor:
    """What a robot saw of the floor.

    Attributes:
        seen: Of `seen_floor`, n by 2, in the robot's frame now [m].
        driven: Where the robot itself was, m by 2, likewise [m].
    """

    seen: Array
    driven: Array

    def against(self, field: LikelihoodField, pose: Array) -> float:
        """What a map says against a pose of the robot (x [m], y [m], heading [rad]), from 0 on."""
        at = to_cell_poses(field.grid, pose[None, :])[0]
        total = 0.0
        for points, wall in ((self.seen, _WALL), (self.driven, _UNKNOWN)):
            if len(points):
                walls, unknown = _count(field.grid.cells, at, points / field.grid.resolution)
                total += (wall * walls + _UNKNOWN * unknown) / len(points)
        return total
