"""Where the robot is on the map, from moment to moment, and why that is not known.

Odometry carries the pose from scan to scan; each scan is compared with the map (`localisation`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skytether_services.planar.geometry import Pose
from skytether_services.planar.transforms import as_array, as_pose, compose, inverse, step

from .controller import MotionLimits
from .grid_map import GridMap
from .likelihood_field import likelihood_field
from .localisation import Estimate, Localisation
from .obstacles import Scan
from .params import LocaliserParams, SensorParams
from .prediction import State
from .senses import Senses
from .status import Code, Trouble


@dataclass(frozen=True)
class Sighting:
    """What a scan told.

    Attributes:
        pose: Of the robot on the map when the scan was taken.
        scan: On the map.
    """

    pose: Pose
    scan: Scan


class Whereabouts(Senses):
    """Of one robot."""

    def __init__(
        self, sensors: SensorParams, localiser: LocaliserParams, limits: MotionLimits, random: np.random.Generator
    ) -> None:
        super().__init__(sensors, limits)
        self._localiser, self._random = localiser, random
        self._localisation: Localisation | None = None
        self._map_from_odometry: Pose | None = None
        self._at_scan: Pose | None = None
        self._was_sure = False
        self._first: Pose | None = None
        self.estimate: Estimate | None = None

    @property
    def particles(self) -> NDArray[np.float64]:
        """Where the robot may be, n by 3; none without a map."""
        return self._localisation.particles if self._localisation is not None else np.empty((0, 3))

    def use_map(self, grid: GridMap) -> None:
        """Begin anew on this map, at the pose that was given before, or anywhere.

        Raises:
            ValueError: It has no free cell.
        """
        self._localisation = Localisation(likelihood_field(grid), self._random, self._localiser.localisation)
        self._map_from_odometry = self.estimate = None
        self._was_sure = False
        if self._first is not None:
            self.place(self._first)

    def place(self, pose: Pose, deviation: float = 0.0, turn: float = 0.0) -> None:
        """Somebody says where the robot is; what is not finite is not heard.

        Args:
            pose: On the map.
            deviation: Standard deviation along each axis [m]; 0: the parameter's.
            turn: Of the heading [rad]; likewise.
        """
        if not all(math.isfinite(value) for value in (*pose, deviation, turn)):
            return
        self._first = pose
        if self._localisation is None:
            return
        deviation = deviation or self._localiser.start_deviation
        turn = turn or self._localiser.start_turn_deviation
        self._localisation.place(as_array(pose), np.diag([deviation**2, deviation**2, turn**2]))
        self.estimate = None
        self._was_sure = False
        newest = self._track.newest
        self._map_from_odometry = compose(pose, inverse(newest.pose)) if newest is not None else None
        self._at_scan = newest.pose if newest is not None else None

    def match_scan(self, now: float) -> Sighting | None:
        """Compare the scan that waits with the map, once there is odometry of its moment; None: nothing new."""
        taken = self.pop_scan(now) if self._localisation is not None else None
        if taken is None or self._localisation is None:
            return None
        scan, at_scan = taken
        moved = step(self._at_scan, at_scan) if self._at_scan is not None else Pose(0.0, 0.0, 0.0)
        self._at_scan = at_scan
        origin = np.array([scan.laser.x, scan.laser.y])
        self.estimate = estimate = self._localisation.update(as_array(moved), scan.points(), origin)
        self._was_sure |= estimate.sure
        pose = as_pose(estimate.pose)
        self._map_from_odometry = compose(pose, inverse(at_scan))
        seen = Scan(
            scan.ranges, scan.angle_min, scan.angle_increment, compose(pose, scan.laser), scan.range_min, scan.range_max
        )
        return Sighting(pose, seen)

    def state(self) -> State | None:
        """Pose on the map and velocity, as new as odometry is; None: not known."""
        newest = self._track.newest
        if newest is None or self._map_from_odometry is None:
            return None
        velocity, age = self._velocity(newest)
        return State(compose(self._map_from_odometry, newest.pose), velocity, newest.at, age)

    def trouble(self, now: float) -> Trouble | None:
        """Why the robot's place is not known well enough to drive."""
        if (unheard := self.unheard(now)) is not None:
            return unheard
        if self._localisation is None:
            return Trouble(Code.NO_MAP, "There is no map yet; set the parameter map, or publish the topic map.")
        if (unsteady := self.unsteady(now)) is not None:
            return unsteady
        if self.estimate is None or not self.estimate.sure:
            if self._was_sure:
                text = "What the laser sees contradicts the map: the robot's place is not known any more."
                return Trouble(Code.LOST, f"{text} Move it, or publish initialpose.")
            text = "The robot has not found its place on the map yet."
            return Trouble(Code.NO_POSE, f"{text} Move it, or publish initialpose.")
        return None
