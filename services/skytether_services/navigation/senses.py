"""What a robot measures of its own motion and around itself, as it comes, and why that is of no use.

Odometry becomes a track without jumps; a scan waits for the odometry of its moment.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skytether.control.admittance import STANDSTILL, Velocity
from skytether_services.planar.geometry import Pose, wrap
from skytether_services.planar.odometry_track import OdometryTrack, Reach, Sample
from skytether_services.planar.transforms import step

from .controller import MotionLimits
from .params import SensorParams
from .status import Code, Trouble

_PATIENCE = 0.15
"""A scan waits so long for odometry that is as new as it is [s]; then the newest has to do."""
_OTHER_CLOCK = 2.0
"""Stamps of scans and odometry that are farther apart come from different clocks [s]: then their arrival counts."""
_TWIST_LASTS = 0.25
"""A measured velocity counts until odometry is newer by this [s]."""
_WINDOW = 0.1
"""Where no velocity is measured, the way within this time tells it [s]."""


@dataclass(frozen=True)
class LaserScan:
    """A scan as it came.

    Attributes:
        stamp: By the robot's clock [s].
        at: The same moment by the service's clock [s].
        ranges: [m].
        angle_min: Direction of the first ray [rad].
        angle_increment: From ray to ray [rad].
        range_min: [m].
        range_max: [m].
        laser: Pose on the robot.
    """

    stamp: float
    at: float
    ranges: NDArray[np.float32]
    angle_min: float
    angle_increment: float
    range_min: float
    range_max: float
    laser: Pose

    @property
    def hits(self) -> NDArray[np.bool_]:
        """Which rays met something."""
        with np.errstate(invalid="ignore"):
            found: NDArray[np.bool_] = (self.ranges > self.range_min) & (self.ranges < self.range_max)
        return found

    def points(self) -> NDArray[np.float64]:
        """Where they did, in the robot's frame, n by 2 [m]."""
        hits = self.hits
        angles = self.angle_min + self.angle_increment * np.flatnonzero(hits) + self.laser.yaw
        ranges = self.ranges[hits].astype(np.float64)
        return np.column_stack((self.laser.x + ranges * np.cos(angles), self.laser.y + ranges * np.sin(angles)))


class Senses:
    """Of one robot."""

    def __init__(self, sensors: SensorParams, limits: MotionLimits) -> None:
        self._sensors = sensors
        # Twice as fast as it is told to be: the robot may be pushed, or driven by its fallback.
        reach = Reach(2 * max(limits.max_linear, 0.5), 2 * limits.max_angular, sensors.jump_distance, sensors.jump_turn)
        self._track = OdometryTrack(reach)
        self._twist: tuple[float, Velocity] | None = None
        self._waiting: LaserScan | None = None
        self._scanned_at = -math.inf
        self._blind = False
        self._jumped_at = -math.inf
        self.laser_frame: str | None = None
        """A frame in which scans come, and which nobody says where it is on the robot; None: it is known."""

    def odometry(self, stamp: float, pose: Pose, at: float, velocity: Velocity | None = None) -> bool:
        """Take dead reckoning, and the velocity if it was measured; returns whether it jumped."""
        if velocity is not None and all(map(math.isfinite, velocity)):
            self._twist = (stamp, velocity)
        jumped = self._track.add(stamp, pose, at)
        if jumped:
            self._jumped_at = at
        return jumped

    def scan(self, scan: LaserScan) -> None:
        """Take a scan; `pop_scan` hands it on. One whose geometry is not finite is a blind one."""
        geometry = (scan.stamp, scan.at, scan.angle_min, scan.angle_increment, scan.range_min, *scan.laser)
        good = all(map(math.isfinite, geometry)) and not math.isnan(scan.range_max) and scan.ranges.size > 0
        self._scanned_at = scan.at if math.isfinite(scan.at) else self._scanned_at
        self._blind = not good or float(scan.hits.mean()) < self._sensors.least_hits
        self._waiting = None if self._blind else scan

    @property
    def dead_reckoning(self) -> Pose | None:
        """The newest pose of the track; None: there is no odometry yet."""
        newest = self._track.newest
        return newest.pose if newest is not None else None

    def pop_scan(self, now: float) -> tuple[LaserScan, Pose] | None:
        """The scan that waits, with the track's pose of its moment, once there is one; None: nothing new."""
        scan, newest = self._waiting, self._track.newest
        if scan is None or newest is None:
            return None
        at_scan = self._moment(scan, newest, now)
        if at_scan is None:
            return None
        self._waiting = None
        return scan, at_scan

    def _moment(self, scan: LaserScan, newest: Sample, now: float) -> Pose | None:
        """The robot's odometry when the scan was taken; None: it has not come yet."""
        if abs(scan.stamp - newest.stamp) > _OTHER_CLOCK:
            return newest.pose
        pose = self._track.pose_at(scan.stamp)
        return newest.pose if pose is None and now - scan.at > _PATIENCE else pose

    def _velocity(self, newest: Sample) -> tuple[Velocity, float]:
        """The velocity, and by how much it is older than the newest pose [s]."""
        if self._twist is not None and abs(newest.stamp - self._twist[0]) <= _TWIST_LASTS:
            return self._twist[1], newest.stamp - self._twist[0]
        before = self._track.pose_at(newest.stamp - _WINDOW)
        if before is None:
            return STANDSTILL, 0.0
        moved = step(before, newest.pose)
        return Velocity(moved.x / _WINDOW, wrap(moved.yaw) / _WINDOW), _WINDOW / 2

    def unheard(self, now: float) -> Trouble | None:
        """What is missing of odometry and scans."""
        newest = self._track.newest
        limit = self._sensors.odometry_timeout
        if newest is None or now - newest.at > limit:
            return Trouble(Code.NO_ODOMETRY, f"No odometry came for {limit:g} s; look at the topics tf and odom.")
        if self.laser_frame is not None:
            text = f"No transform leads from the robot to the frame of its scans, '{self.laser_frame}'."
            return Trouble(Code.NO_LASER_POSE, f"{text} Publish it on tf, or set the parameter sensors.laser.")
        limit = self._sensors.scan_timeout
        if now - self._scanned_at > limit:
            return Trouble(Code.NO_SCAN, f"No laser scan came for {limit:g} s; look at the topic scan.")
        if self._blind:
            text = "The laser sees nothing: nearly all ranges are NaN or out of reach; is its window covered?"
            return Trouble(Code.SCAN_USELESS, text)
        return None

    def unsteady(self, now: float) -> Trouble | None:
        """The odometry jumped a moment ago."""
        if now - self._jumped_at < self._sensors.settle:
            return Trouble(Code.ODOMETRY_JUMPED, "The odometry jumped; the robot stands until it is steady.")
        return None
