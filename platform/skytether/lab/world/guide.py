"""A driver who knows where the robot is and stops before what the laser sees: shows the world without any service.

No navigation: it goes straight from goal to goal, which in the plan of the building are straight and free.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from skytether.lab.trail import Pose
from skytether.messages import LaserScan, Twist, Vector3

from .robot import RobotParams

SPEED = 0.5
"""m/s."""
REACHED = 0.25
"""A goal is reached when the robot is so near, m."""
_TURN = 0.8
"""rad/s."""
_STEER = 1.5
"""Turning rate per angle to the goal, 1/s."""
_AIM = 0.35
"""It stands and turns for a larger angle, rad."""
_STOP, _SLOW = 0.45, 1.2
"""From the front of the robot to what stands in its way: it stands, and goes at full speed, m."""
_BESIDE = 0.1
"""What is farther beside the robot is not in its way, m."""


class Guide:
    """Goes through goals in their order."""

    def __init__(self, goals: Sequence[Pose], params: RobotParams) -> None:
        self._goals = tuple(goals)
        self._params = params
        self.reached = 0
        """How many goals so far."""

    @property
    def done(self) -> bool:
        """Whether that were all."""
        return self.reached == len(self._goals)

    def step(self, pose: Pose, scan: LaserScan | None) -> Twist:
        """The velocity to command now."""
        while not self.done and math.dist(pose[:2], self._goals[self.reached][:2]) < REACHED:
            self.reached += 1
        if self.done:
            return Twist()
        goal = self._goals[self.reached]
        angle = math.remainder(math.atan2(goal.y - pose.y, goal.x - pose.x) - pose.heading, math.tau)
        turning = min(max(_STEER * angle, -_TURN), _TURN)
        speed = 0.0 if abs(angle) > _AIM else SPEED * self._share(scan)
        return Twist(Vector3(x=speed), Vector3(z=turning))

    def _share(self, scan: LaserScan | None) -> float:
        """Of the full speed, by what stands in the way; nothing without a scan."""
        if scan is None:
            return 0.0
        angles = scan.angle_min + np.arange(len(scan.ranges)) * scan.angle_increment
        ranges = np.where(np.isfinite(scan.ranges), scan.ranges, scan.range_max)
        x = self._params.laser_x + ranges * np.cos(angles) - self._params.length / 2
        ahead = x[(np.abs(ranges * np.sin(angles)) < self._params.width / 2 + _BESIDE) & (x > 0)]
        room = float(ahead.min()) if len(ahead) else math.inf
        return min(max((room - _STOP) / (_SLOW - _STOP), 0.0), 1.0)
