"""What a robot's laser and sonars see of the model, and its messages."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skytether.lab.trail import Pose
from skytether.messages import (
    Header,
    LaserScan,
    Odometry,
    Point,
    PoseWithCovariance,
    Quaternion,
    Range,
    TFMessage,
    Time,
    Transform,
    TransformStamped,
    Twist,
    TwistWithCovariance,
    Vector3,
    quaternion_from_yaw,
)
from skytether.messages import Pose as PoseMessage

from .model import load_mujoco
from .robot import Motion, RearParams, RobotParams

_SONAR_RAYS = 7
"""In the cone of one sonar, flat: the nearest answers."""


class Eyes:
    """Laser and sonars of one robot; the robot itself is not seen.

    Args:
        model: ``MjModel``.
        data: ``MjData``, looked at as it is at each call.
        body: The robot's.
        params: Of the robot.
        random: For the noise.
    """

    def __init__(self, model: Any, data: Any, body: int, params: RobotParams, random: np.random.Generator) -> None:
        self._mujoco = load_mujoco()
        self._model, self._data, self._body, self._params, self._random = model, data, body, params, random
        self._angles = np.linspace(-params.laser_field / 2, params.laser_field / 2, params.laser_rays)
        self._cone = np.linspace(-params.sonar_cone / 2, params.sonar_cone / 2, _SONAR_RAYS)

    def ranges(self, pose: Pose) -> NDArray[np.float64]:
        """Of the laser without any noise [m]; infinite where nothing is within reach."""
        return self._sweep(pose, self._params.laser_x, self._params.laser_z)

    def rear_ranges(self, pose: Pose) -> NDArray[np.float64]:
        """Likewise of the laser that looks back.

        Raises:
            ValueError: The robot has none.
        """
        rear = self._params.rear
        if rear is None:
            raise ValueError("this robot has no laser that looks back")
        x, y, heading = pose
        return self._sweep(Pose(x, y, heading + math.pi), -rear.laser_x, rear.laser_z)

    def scan(self, pose: Pose, header: Header, period: float) -> LaserScan:
        """One sweep, taken at once."""
        return self._measured(self.ranges(pose), header, period)

    def rear_scan(self, pose: Pose, header: Header, period: float) -> LaserScan:
        """The same of the laser that looks back; ValueError where there is none."""
        return self._measured(self.rear_ranges(pose), header, period)

    def _sweep(self, pose: Pose, ahead: float, height: float) -> NDArray[np.float64]:
        """Of a laser so far ahead of this pose, that looks along it."""
        x, y = pose.x + ahead * math.cos(pose.heading), pose.y + ahead * math.sin(pose.heading)
        return self._cast((x, y, height), self._angles + pose.heading, self._params.laser_max)

    def _measured(self, ranges: NDArray[np.float64], header: Header, period: float) -> LaserScan:
        p, random = self._params, self._random
        ranges += random.normal(size=len(ranges)) * p.laser_noise
        ranges[random.random(len(ranges)) < p.laser_lost] = np.inf
        ranges[ranges > p.laser_max] = np.inf
        return LaserScan(
            header=header,
            angle_min=float(self._angles[0]),
            angle_max=float(self._angles[-1]),
            angle_increment=float(self._angles[1] - self._angles[0]),
            scan_time=period,
            range_min=p.laser_min,
            range_max=p.laser_max,
            ranges=ranges.astype(np.float32),
        )

    def sonars(self, pose: Pose, stamp: Time) -> list[Range]:
        """One reading of each; the farthest range where nothing is heard."""
        p, found = self._params, []
        for index, angle in enumerate(p.sonar_angles):
            reach = sonar_radius(p, angle)
            heading = pose.heading + angle
            origin = (pose.x + reach * math.cos(heading), pose.y + reach * math.sin(heading), p.laser_z)
            heard = float(self._cast(origin, self._cone + heading, p.sonar_max).min())
            told = min(max(heard + p.sonar_noise * float(self._random.normal()), p.sonar_min), p.sonar_max)
            header = Header(stamp, f"sonar_{index}")
            found.append(Range(header, 0, p.sonar_cone, p.sonar_min, p.sonar_max, told))
        return found

    def _cast(
        self, origin: tuple[float, float, float], angles: NDArray[np.float64], reach: float
    ) -> NDArray[np.float64]:
        count = len(angles)
        rays = np.stack([np.cos(angles), np.sin(angles), np.zeros(count)], axis=1).ravel()
        geoms, ranges = np.empty(count, np.int32), np.empty(count)
        self._mujoco.mj_multiRay(
            self._model, self._data, np.array(origin), rays, None, True, self._body, geoms, ranges, None, count, reach
        )
        ranges[(geoms < 0) | (ranges < 0)] = np.inf  # a miss is told as -1
        return ranges


def sonar_radius(params: RobotParams, angle: float) -> float:
    """From the robot's middle to the edge of its box in that direction [m]."""
    cos, sin = abs(math.cos(angle)), abs(math.sin(angle))
    return min(params.length / 2 / max(cos, 1e-9), params.width / 2 / max(sin, 1e-9))


def odometry(pose: Pose, motion: Motion, stamp: Time, prefix: str) -> Odometry:
    """Dead reckoning as a message."""
    x, y, heading = pose
    return Odometry(
        Header(stamp, f"{prefix}odom"),
        f"{prefix}base_link",
        PoseWithCovariance(PoseMessage(Point(x, y), quaternion_from_yaw(heading))),
        TwistWithCovariance(Twist(Vector3(motion.forward, motion.left), Vector3(z=motion.turning))),
    )


def transforms(pose: Pose, params: RobotParams, stamp: Time, prefix: str) -> TFMessage:
    """Base in the odometry's frame, and what looks on the base.

    The frame ``camera`` is one of bodies, not of pictures: x along the camera's axis, z up in the picture.
    """
    base, rear = f"{prefix}base_link", params.rear
    found = [
        _transform(f"{prefix}odom", base, (pose.x, pose.y, 0.0), quaternion_from_yaw(pose.heading), stamp),
        _transform(base, f"{prefix}laser", (params.laser_x, 0.0, params.laser_z), quaternion_from_yaw(0.0), stamp),
    ]
    if rear is not None:
        back = quaternion_from_yaw(math.pi)
        found += [
            _transform(base, f"{prefix}rear_laser", (rear.laser_x, 0.0, rear.laser_z), back, stamp),
            _transform(base, f"{prefix}camera", (rear.camera_x, 0.0, rear.camera_z), _back_and_up(rear), stamp),
        ]
    return TFMessage(tuple(found))


def _back_and_up(rear: RearParams) -> Quaternion:
    """Half a turn about z, and then about the new y, which lifts x by the angle."""
    half = rear.camera_up / 2
    return Quaternion(x=math.sin(half), z=math.cos(half), w=0.0)


def _transform(parent: str, child: str, at: Sequence[float], turned: Quaternion, stamp: Time) -> TransformStamped:
    return TransformStamped(Header(stamp, parent), child, Transform(Vector3(*at), turned))
