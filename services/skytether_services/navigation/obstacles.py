"""Obstacles that sensors see: each ray clears the cells on its way and marks the one where it ends.

As costmap_2d's obstacle layer: all rays clear first, then all mark, so that no ray removes what another one of the same
scan has seen. A layer's cells are free, lethal, or unknown (nobody looked there).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skytether.service import param
from skytether_services.planar.geometry import Pose

from .compiled import compiled
from .costmap import FREE, LETHAL, Costs

_FREE, _LETHAL = FREE, LETHAL


@dataclass(frozen=True)
class ObstacleParams:
    """What a scan does to the obstacle layer."""

    mark_range: float = param(3.0, unit="m", gt=0, doc="what is farther away is not marked")
    clear_range: float = param(3.5, unit="m", gt=0, doc="cells farther away are not cleared")


@dataclass(frozen=True)
class Scan:
    """A laser scan in the frame of the costmap.

    Attributes:
        ranges: One for each ray [m]; infinite: nothing within reach; NaN, and what is not above range_min: no answer.
        angle_min: Direction of the first ray from the sensor's own [rad].
        angle_increment: From ray to ray [rad].
        sensor: The sensor's pose in the costmap's frame.
        range_min: Shorter ones are the robot itself, or noise [m].
        range_max: Longer ones saw nothing [m].
    """

    ranges: NDArray[np.float32]
    angle_min: float
    angle_increment: float
    sensor: Pose
    range_min: float = 0.05
    range_max: float = 30.0


@compiled
def _clear_ray(marks: NDArray[np.uint8], r0: int, c0: int, r1: int, c1: int) -> None:
    """Bresenham's line from a cell of the layer, up to and without the last cell; it ends at the border."""
    rows, columns = marks.shape
    dr, dc = abs(r1 - r0), abs(c1 - c0)
    step_r = 1 if r1 > r0 else -1
    step_c = 1 if c1 > c0 else -1
    error = dc - dr
    r, c = r0, c0
    while not (r == r1 and c == c1):
        if r < 0 or c < 0 or r >= rows or c >= columns:
            return
        marks[r, c] = _FREE
        twice = 2 * error
        if twice > -dr:
            error -= dr
            c += step_c
        if twice < dc:
            error += dc
            r += step_r


@compiled
def _trace(
    marks: NDArray[np.uint8],
    ranges: NDArray[np.float32],
    angle: float,
    increment: float,
    fx: float,
    fy: float,
    limits: tuple[float, float, float, float],
) -> int:
    """All lengths in cells. Returns how many rays marked."""
    rows, columns = marks.shape
    range_min, range_max, mark_range, clear_range = limits
    c0, r0 = int(np.floor(fx)), int(np.floor(fy))
    if c0 < 0 or r0 < 0 or c0 >= columns or r0 >= rows:
        return 0
    for i in range(ranges.shape[0]):
        distance = ranges[i]
        if not distance > range_min:
            continue
        reach = min(distance, clear_range)
        a = angle + i * increment
        c1, r1 = int(np.floor(fx + reach * np.cos(a))), int(np.floor(fy + reach * np.sin(a)))
        _clear_ray(marks, r0, c0, r1, c1)
        # A ray that is cut short, or met nothing, saw its last cell free as well.
        if distance > clear_range and c1 >= 0 and r1 >= 0 and c1 < columns and r1 < rows:
            marks[r1, c1] = _FREE
    marked = 0
    for i in range(ranges.shape[0]):
        distance = ranges[i]
        if not (distance > range_min and distance < range_max and distance <= mark_range):
            continue
        a = angle + i * increment
        c1, r1 = int(np.floor(fx + distance * np.cos(a))), int(np.floor(fy + distance * np.sin(a)))
        if c1 >= 0 and r1 >= 0 and c1 < columns and r1 < rows:
            marks[r1, c1] = _LETHAL
            marked += 1
    return marked


def mark_and_clear(
    marks: Costs, resolution: float, origin: tuple[float, float], scan: Scan, params: ObstacleParams
) -> int:
    """Put a scan into the layer, in place.

    Args:
        marks: The layer.
        resolution: Side of a cell [m].
        origin: x, y of the corner of cell (0, 0) [m].
        scan: In the same frame.
        params: Ranges.

    Returns:
        How many rays marked a cell. A sensor off the map, or whose pose is not finite, does nothing.
    """
    x, y, yaw = scan.sensor
    angle = yaw + scan.angle_min
    if not np.isfinite([x, y, angle, scan.angle_increment]).all():
        return 0
    ranges = scan.ranges.astype(np.float32) / np.float32(resolution)
    limits = (
        scan.range_min / resolution,
        scan.range_max / resolution,
        params.mark_range / resolution,
        params.clear_range / resolution,
    )
    fx, fy = (x - origin[0]) / resolution, (y - origin[1]) / resolution
    return _trace(marks, ranges, angle, scan.angle_increment, fx, fy, limits)
