"""The robot's outline, and whether it hits something on a costmap.

The cost of the cell below the robot's centre tells most of it: from 253 (inscribed) on it collides whichever way it
turns; below the cost at the circumscribed radius it cannot. Only in between the area of a polygon is looked at.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from skytether_services.planar.geometry import Pose

from .compiled import compiled
from .costmap import INSCRIBED, LETHAL, UNKNOWN, Costmap, InflationParams, cost_of_distance

# Machine code knows a module's own constants only.
_INSCRIBED, _LETHAL, _UNKNOWN = INSCRIBED, LETHAL, UNKNOWN


@dataclass(frozen=True)
class Footprint:
    """A circle, or a polygon that holds the robot's centre of rotation.

    Attributes:
        radius: Of the circle [m]; not looked at where there are corners.
        corners: Of the polygon [m], in order, in the robot's frame (x forward, y to the left); convex. Empty: a circle.
        padding: Added all around [m]: cells are coarse, and so is a pose.
    """

    radius: float = 0.3
    corners: tuple[tuple[float, float], ...] = ()
    padding: float = 0.02

    def __post_init__(self) -> None:
        """Raises ValueError for what is no outline around the centre of rotation; the text names the field."""
        if not (math.isfinite(self.padding) and self.padding >= 0):
            raise ValueError(f"footprint: padding must be 0 or above and finite, not {self.padding}")
        if not self.corners:
            if not (math.isfinite(self.radius) and self.radius > 0):
                raise ValueError(f"footprint: radius must be above 0 and finite, not {self.radius}")
            return
        if len(self.corners) < 3:
            raise ValueError(f"footprint: corners must be at least 3, not {len(self.corners)}")
        if not all(math.isfinite(value) for corner in self.corners for value in corner):
            raise ValueError("footprint: a corner is not finite")
        if self._edge_distances().min() <= 0:
            raise ValueError("footprint: corners must go round a convex outline with the robot's centre inside")

    def _edge_distances(self) -> NDArray[np.float64]:
        """From the centre to the line of each edge; negative where the outline is not convex around the centre."""
        corners = np.array(self.corners)
        ahead = np.roll(corners, -1, axis=0)
        edges = ahead - corners
        lengths = np.maximum(np.hypot(edges[:, 0], edges[:, 1]), 1e-12)
        cross = (corners[:, 0] * ahead[:, 1] - corners[:, 1] * ahead[:, 0]) / lengths
        following = np.roll(edges, -1, axis=0)
        bends = edges[:, 0] * following[:, 1] - edges[:, 1] * following[:, 0]
        sign = math.copysign(1.0, float(cross.sum()))
        result: NDArray[np.float64] = np.where(bends * sign >= -1e-12, cross * sign, -1.0)
        return result

    @property
    def inscribed(self) -> float:
        """Radius of the largest circle around the centre that the padded outline holds [m]."""
        return (float(self._edge_distances().min()) if self.corners else self.radius) + self.padding

    @property
    def circumscribed(self) -> float:
        """Radius of the smallest circle around the centre that holds the padded outline [m]."""
        if not self.corners:
            return self.inscribed
        return float(np.hypot(*self._padded().T).max())

    def _padded(self) -> NDArray[np.float64]:
        """Corners, each moved away from the centre so far that every edge moves by the padding at least."""
        corners = np.array(self.corners)
        return corners * (1.0 + self.padding / float(self._edge_distances().min()))

    def samples(self, spacing: float) -> NDArray[np.float64]:
        """Points of the padded area that the inscribed circle leaves out [m], n by 2; none for a circle.

        Args:
            spacing: At most this far apart along each axis, and along the edges [m].
        """
        if not self.corners:
            return np.empty((0, 2))
        corners = self._padded()
        points = []
        for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            n = max(1, math.ceil(math.hypot(*(b - a)) / spacing))
            points.append(a + (b - a) * (np.arange(n) / n)[:, None])
        # Rings inwards from the outline: a small obstacle within the outline is found, too.
        outline = np.concatenate(points)
        rings = math.ceil(self.circumscribed / spacing)
        area = np.concatenate([outline * (1 - i / rings) for i in range(rings)])
        outside = np.hypot(area[:, 0], area[:, 1]) > self.inscribed - spacing
        outside[: len(outline)] = True
        result: NDArray[np.float64] = area[outside]
        return result


@compiled
def footprint_cost(
    costs: NDArray[np.uint8],
    resolution: float,
    origin_x: float,
    origin_y: float,
    x: float,
    y: float,
    cos: float,
    sin: float,
    samples: NDArray[np.float64],
    check_from: int,
) -> int:
    """Cost of the robot standing at a pose: 254 where it collides, else that of its centre; what is unknown is free.

    Args:
        costs: Inflated, rows by columns.
        resolution: Side of a cell [m].
        origin_x: Of the corner of cell (0, 0) [m].
        origin_y: Likewise.
        x: Of the robot's centre [m].
        y: Likewise.
        cos: Of its yaw.
        sin: Likewise.
        samples: ``Footprint.samples``.
        check_from: Least cost of the centre at which a sample may collide.
    """
    rows, columns = costs.shape
    scale = 1.0 / resolution
    fx = (x - origin_x) * scale
    fy = (y - origin_y) * scale
    if fx < 0.0 or fy < 0.0 or fx >= columns or fy >= rows:
        return 0
    cost = int(costs[int(fy), int(fx)])
    if cost == _UNKNOWN:
        cost = 0
    elif cost >= _INSCRIBED:
        return _LETHAL
    if cost < check_from:
        return cost
    for i in range(samples.shape[0]):
        sx = fx + (cos * samples[i, 0] - sin * samples[i, 1]) * scale
        sy = fy + (sin * samples[i, 0] + cos * samples[i, 1]) * scale
        if sx >= 0.0 and sy >= 0.0 and sx < columns and sy < rows and costs[int(sy), int(sx)] == _LETHAL:
            return _LETHAL
    return cost


@compiled
def misfits(
    path: NDArray[np.float64],
    costs: NDArray[np.uint8],
    frame: NDArray[np.float64],
    samples: NDArray[np.float64],
    check_from: int,
) -> NDArray[np.bool_]:
    """Where along a path the robot's outline collides, while it faces along the path and turns from piece to piece.

    Args:
        path: n by 3: x [m], y [m], yaw to the next pose [rad].
        costs: Inflated, rows by columns.
        frame: Resolution, and x, y of the corner of cell (0, 0) [m].
        samples: Of the footprint.
        check_from: As in ``footprint_cost``.
    """
    found = np.zeros(path.shape[0], np.bool_)
    yaw = path[0, 2]
    for i in range(path.shape[0]):
        turn = path[i, 2] - yaw
        turn -= 2 * math.pi * math.floor((turn + math.pi) / (2 * math.pi))
        steps = max(1, math.ceil(abs(turn) / 0.1))
        for k in range(1, steps + 1):
            at = yaw + turn * k / steps
            cos, sin = math.cos(at), math.sin(at)
            cost = footprint_cost(
                costs, frame[0], frame[1], frame[2], path[i, 0], path[i, 1], cos, sin, samples, check_from
            )
            found[i] = found[i] or cost == _LETHAL
        yaw = path[i, 2]
    return found


def cost_at(costmap: Costmap, footprint: Footprint, pose: Pose) -> int:
    """Cost of the robot standing at a pose: 254 where any of it is in a lethal cell, else that of its centre."""
    samples = footprint.samples(costmap.resolution / 2)
    cos, sin = math.cos(pose.yaw), math.sin(pose.yaw)
    x, y = costmap.origin
    return footprint_cost(costmap.costs, costmap.resolution, x, y, pose.x, pose.y, cos, sin, samples, 0)


class FootprintChecks:
    """What ``footprint_cost`` needs, for one footprint and costmaps of one inflation."""

    def __init__(self, footprint: Footprint, inflation: InflationParams, margin: float = 0.0) -> None:
        """Take the outline with so much more around it [m]."""
        self._footprint, self._inflation = footprint, inflation
        self._wider = replace(footprint, padding=footprint.padding + margin)
        self._known: tuple[float, NDArray[np.float64], int] | None = None

    def on(self, costmap: Costmap) -> tuple[NDArray[np.float64], NDArray[np.float64], int]:
        """Frame of the costmap (resolution, x, y of its corner [m]), samples, and the cost to check them from."""
        resolution = costmap.resolution
        if self._known is None or self._known[0] != resolution:
            # A cell more: both the centre and the obstacle may be anywhere in theirs.
            reach = self._wider.circumscribed + resolution
            cost = cost_of_distance(reach, self._footprint.inscribed, self._inflation.decay)
            check_from = cost if reach <= self._inflation.radius else 0
            self._known = (resolution, self._wider.samples(resolution), check_from)
        return np.array([resolution, *costmap.origin]), self._known[1], self._known[2]
