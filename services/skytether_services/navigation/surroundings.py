"""What is around the robot: the map, what its laser saw, and zones, as the costmaps of planner and controller."""

from __future__ import annotations

import math
from collections.abc import Callable

from skytether.service import Rate
from skytether_services.planar.geometry import Pose

from .costmap import INSCRIBED, LETHAL, Costmap, Costs, static_costs
from .footprint import Footprint
from .grid_map import GridMap
from .layers import LayeredCostmap
from .neighbours import Neighbours
from .params import Params
from .status import Code
from .whereabouts import Sighting
from .zones import Mask, speed_limit


def mask_of(grid: GridMap) -> Mask:
    """A zone's mask from its map."""
    return Mask(grid.cells, grid.resolution, grid.origin[:2])


class _Layers:
    """One costmap, brought up to date at its own rate."""

    def __init__(self, layers: LayeredCostmap, hertz: float) -> None:
        self.layers = layers
        self.costmap: Costmap | None = None
        self._own: Costmap | None = None
        self._rate = Rate(hertz)
        self._newest: Sighting | None = None

    def update(
        self, now: float, sighting: Sighting | None, pose: Pose, others: Callable[[], Costs | None] = lambda: None
    ) -> None:
        """Take the newest scan in, and what others say, if it is time to."""
        self._newest = sighting or self._newest
        if not self._rate.due(now):
            return
        self.layers.others, self._own = others(), None
        if self._newest is not None:
            self.layers.observe(self._newest.pose, self._newest.scan)
            self._newest = None
        self.costmap = self.layers.update(pose)

    @property
    def own(self) -> Costmap | None:
        """The costmap without what others say; made when somebody asks."""
        if self.layers.others is None:
            return self.costmap
        if self._own is None:
            self._own = self.layers.compose(with_others=False)
        return self._own


class Surroundings:
    """Of one robot on one map."""

    def __init__(
        self, grid: GridMap, params: Params, footprint: Footprint, keep_out: Mask | None, speed: Mask | None
    ) -> None:
        """Begin with what the map says.

        Args:
            grid: The map.
            params: Of the service.
            footprint: Of the robot.
            keep_out: Zones that no part of the robot may enter.
            speed: Zones with a limit of speed.

        Raises:
            ValueError: The map is turned, or the inflation is less than the robot's size; the text says what to do.
        """
        if abs(grid.origin[2]) > 1e-6:
            raise ValueError("the map's origin is turned; make it anew with yaw 0")
        static = Costmap(static_costs(grid.cells), grid.resolution, grid.origin[:2])
        common = {"inflation": params.inflation, "obstacles": params.obstacles, "keep_out": keep_out}
        self._global = _Layers(LayeredCostmap(static, footprint, **common), params.rates.global_costmap)  # type: ignore[arg-type]
        near = LayeredCostmap(static, footprint, **common, rolling=params.window)  # type: ignore[arg-type]
        self._local = _Layers(near, params.rates.local_costmap)
        self.neighbours = Neighbours(params.sharing, static, footprint, params.obstacles)
        self.known = self._global.layers.compose()
        """What the map and the zones alone say."""
        self._speed = speed
        self._max_linear = params.limits.max_linear

    def update(self, now: float, pose: Pose, sighting: Sighting | None) -> None:
        """Bring both costmaps up to date where they are due.

        Args:
            now: [s].
            pose: Of the robot on the map.
            sighting: A new scan.
        """
        if sighting is not None:
            self.neighbours.observe(now, sighting.pose, sighting.scan)
        self._global.update(now, sighting, pose, lambda: self.neighbours.costs(now, pose))
        self._local.update(now, sighting, pose)

    @property
    def whole(self) -> Costmap | None:
        """The planner's; None before the first update."""
        return self._global.costmap

    @property
    def own(self) -> Costmap | None:
        """The planner's without what other robots say: the same one where they say nothing."""
        return self._global.own

    def word(self, now: float, pose: Pose) -> str | None:
        """What to tell the other robots of the group; None: there is no group."""
        return self.neighbours.word(now, pose, self._global.layers.marks)

    @property
    def near(self) -> Costmap | None:
        """The controller's, a window around the robot; likewise."""
        return self._local.costmap

    def refusal(self, goal: Pose, tolerance: float) -> Code | None:
        """Why a goal can never be reached, whatever the laser sees; None: the map does not say so.

        Args:
            goal: On the map.
            tolerance: A place as near as this would do [m].
        """
        cell = self.known.cell(goal.x, goal.y)
        if cell is None:
            return Code.GOAL_OFF_MAP
        reach = math.ceil(tolerance / self.known.resolution)
        (row, column), costs = cell, self.known.costs
        around = costs[max(row - reach, 0) : row + reach + 1, max(column - reach, 0) : column + reach + 1]
        return Code.GOAL_BLOCKED if bool(((around == INSCRIBED) | (around == LETHAL)).all()) else None

    def clear(self, *, whole: bool = True, near: bool = True) -> None:
        """Forget what the laser saw."""
        for layers, wanted in ((self._global.layers, whole), (self._local.layers, near)):
            if wanted:
                layers.clear()

    def speed_limit(self, pose: Pose) -> float:
        """Of the zone in which the robot is [m/s]; infinite: none."""
        if self._speed is None:
            return math.inf
        return speed_limit(self._speed, pose.x, pose.y, self._max_linear)
