"""A costmap with its layers: static map, what sensors saw, keep-out zones, inflation; whole, or a window that rolls."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from skytether.service import param
from skytether_services.planar.geometry import Pose

from .costmap import (
    FREE,
    LETHAL,
    UNKNOWN,
    Costmap,
    Costs,
    InflationParams,
    combine,
    inflate,
    inflation_table,
    shifted,
    window,
)
from .footprint import Footprint
from .obstacles import ObstacleParams, Scan, mark_and_clear
from .zones import Mask, keep_out_costs


@dataclass(frozen=True)
class WindowParams:
    """The part around the robot that the controller looks at."""

    width: float = param(6.0, unit="m", gt=0, doc="along x")
    height: float = param(6.0, unit="m", gt=0, doc="along y")


class LayeredCostmap:
    """Keeps what sensors saw; everything else is computed anew with each update."""

    def __init__(
        self,
        static: Costmap,
        footprint: Footprint,
        *,
        inflation: InflationParams | None = None,
        obstacles: ObstacleParams | None = None,
        rolling: WindowParams | None = None,
        keep_out: Mask | None = None,
    ) -> None:
        """Begin without marks.

        Args:
            static: The map; without inflation.
            footprint: Its circles are what is inflated; cells below it are free.
            inflation: How costs fall off.
            obstacles: Ranges of the sensors.
            rolling: Size of the window around the robot; None: the whole map.
            keep_out: Zones that no part of the robot may enter.

        Raises:
            ValueError: The inflation radius is less than the footprint's circumscribed radius.
        """
        self._inflation = inflation or InflationParams()
        if self._inflation.radius < footprint.circumscribed:
            reach = f"{footprint.circumscribed:.3f} m"
            raise ValueError(f"inflation: radius must be at least the footprint's circumscribed radius, {reach}")
        self._static = static
        if keep_out is not None:
            zones = keep_out_costs(keep_out, static)
            self._static = Costmap(combine(static.costs, zones), static.resolution, static.origin)
        self._obstacles = obstacles or ObstacleParams()
        self._rolling = rolling
        self._table = inflation_table(static.resolution, footprint.inscribed, self._inflation)
        self._below = footprint.samples(static.resolution / 2)
        self._inscribed = footprint.inscribed
        self._base = self._static if rolling is None else window(static, *static.origin, rolling.width, rolling.height)
        self._marks = np.full_like(self._base.costs, UNKNOWN)
        self.others: Costs | None = None
        """What others say, on the cells of the whole map, not of a window; None: nothing."""

    @property
    def marks(self) -> Costs:
        """What sensors saw, on the cells of the last update: free, lethal or unknown. Not a copy."""
        return self._marks

    def clear(self) -> None:
        """Forget what sensors saw."""
        self._marks.fill(UNKNOWN)

    def observe(self, pose: Pose, scan: Scan | None) -> None:
        """Move the window to the robot and put a scan in; a pose that is not finite does nothing.

        Args:
            pose: Of the robot in the map.
            scan: In the map, too; None: the sensor has said nothing new.
        """
        if not all(math.isfinite(value) for value in pose):
            return
        if self._rolling is not None:
            self._roll(pose, self._rolling)
        if scan is not None:
            mark_and_clear(self._marks, self._base.resolution, self._base.origin, scan, self._obstacles)
        self._free_below(pose)

    def compose(self, *, with_others: bool = True) -> Costmap:
        """All layers together, inflated; or all but what others say."""
        costs = combine(self._base.costs, self._marks)
        if with_others and self.others is not None:
            costs = combine(costs, self.others)
        return Costmap(inflate(costs, self._table), self._base.resolution, self._base.origin)

    def update(self, pose: Pose, scan: Scan | None = None) -> Costmap:
        """``observe``, then ``compose``."""
        self.observe(pose, scan)
        return self.compose()

    def _roll(self, pose: Pose, size: WindowParams) -> None:
        before = self._base
        self._base = window(self._static, pose.x, pose.y, size.width, size.height)
        columns = round((self._base.origin[0] - before.origin[0]) / before.resolution)
        rows = round((self._base.origin[1] - before.origin[1]) / before.resolution)
        if rows or columns:
            self._marks = shifted(self._marks, rows, columns)

    def _free_below(self, pose: Pose) -> None:
        """Where the robot stands nothing else is: marks there are noise, or its own parts."""
        height, width = self._marks.shape
        x = (pose.x - self._base.origin[0]) / self._base.resolution
        y = (pose.y - self._base.origin[1]) / self._base.resolution
        reach = self._inscribed / self._base.resolution
        r0, r1 = max(math.floor(y - reach), 0), min(math.ceil(y + reach) + 1, height)
        c0, c1 = max(math.floor(x - reach), 0), min(math.ceil(x + reach) + 1, width)
        if r0 >= r1 or c0 >= c1:
            return
        near = (np.arange(r0, r1)[:, None] + 0.5 - y) ** 2 + (np.arange(c0, c1) + 0.5 - x) ** 2 <= reach**2
        part = self._marks[r0:r1, c0:c1]
        part[near & (part == LETHAL)] = FREE
        if len(self._below):
            cos, sin = math.cos(pose.yaw), math.sin(pose.yaw)
            turned = self._below @ np.array([[cos, sin], [-sin, cos]]) / self._base.resolution
            rows = np.floor(turned[:, 1] + y).astype(int)
            columns = np.floor(turned[:, 0] + x).astype(int)
            inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
            rows, columns = rows[inside], columns[inside]
            hit = self._marks[rows, columns] == LETHAL
            self._marks[rows[hit], columns[hit]] = FREE
