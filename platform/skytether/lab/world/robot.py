"""The robot as a machine, after the Pioneer LX of the thesis: its measures, its drive, its dead reckoning. Pure.

The drive is two motors with limited force that follow a velocity; what stands in the way stops it. Odometry is what
the wheels rolled, with a scale that is a little wrong, a drift, and slip.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from skytether.lab.trail import ORIGIN, Pose


@dataclass(frozen=True, slots=True)
class RearParams:
    """What looks at the person behind a robot that has it: a laser for the legs, a camera for the face.

    Rays, field, ranges and noise are those of the laser in front.

    Attributes:
        laser_x: Of the laser in front of the robot's middle [m]; it looks back.
        laser_z: Of the laser above the floor [m]: it stands on the body, far enough in to measure a foot at its rear.
        camera_x: Of the camera in front of the middle [m]; it looks back and a little up.
        camera_z: Of the camera above the floor [m].
        camera_up: Angle of its axis above the horizontal [rad]: faces 1.4 to 1.7 m high are in view from 0.7 to 2.2 m.
        camera_field: Horizontal field of view [rad].
        width: Of a picture [pixels].
        height: Likewise.
        rate: Pictures a second [Hz].
    """

    laser_x: float = -0.05
    laser_z: float = 0.46
    camera_x: float = -0.05
    camera_z: float = 1.2
    camera_up: float = math.radians(18)
    camera_field: float = math.radians(62)
    width: int = 640
    height: int = 480
    rate: float = 15.0


@dataclass(frozen=True, slots=True)
class RobotParams:
    """The machine.

    Attributes:
        length: Of the body [m].
        width: Of the body [m].
        corner: Cut off each corner [m].
        height: Of the body [m].
        ground_clearance: Below it [m].
        mass: [kg].
        max_speed: Of the drive, forwards and backwards [m/s].
        max_turn: Of the drive [rad/s].
        acceleration: Of the drive, also when it brakes [m/s^2].
        turn_acceleration: The same about the vertical axis [rad/s^2].
        time_constant: Of the motors' answer [s].
        push: Largest force of the drive [N].
        grip: Largest force of the tyres sideways [N].
        twist: Largest torque of the drive [N m].
        timeout: The motors stop when no velocity was written for so long [s].
        laser_x: Of the laser in front of the middle [m].
        laser_z: Of the laser above the floor [m].
        laser_rays: In one sweep.
        laser_field: Angle between the first and the last of them [rad].
        laser_min: Nearest range [m].
        laser_max: Farthest range [m].
        laser_noise: Standard deviation of a range [m].
        laser_lost: Share of the rays that bring nothing back.
        sonar_angles: Directions of the sonars [rad]; they sit on the body's edge.
        sonar_cone: Opening angle [rad].
        sonar_min: Nearest range [m].
        sonar_max: Farthest range [m].
        sonar_noise: Standard deviation of a range [m].
        way_scale: Standard deviation of the odometry's error of scale, one draw for each robot.
        turn_scale: The same of angles.
        slip: Standard deviation of the way rolled per square root of metre [m^0.5].
        turn_slip: Of the angle per square root of radian turned [rad^0.5].
        drift: Of the angle per square root of metre rolled [rad/m^0.5].
        rear: Laser and camera that look back; None: it has neither.
    """

    length: float = 0.70
    width: float = 0.50
    corner: float = 0.08
    height: float = 0.38
    ground_clearance: float = 0.06
    mass: float = 60.0
    max_speed: float = 1.2
    max_turn: float = 2.0
    acceleration: float = 1.0
    turn_acceleration: float = 3.0
    time_constant: float = 0.05
    push: float = 200.0
    grip: float = 400.0
    twist: float = 60.0
    timeout: float = 0.5
    laser_x: float = 0.20
    laser_z: float = 0.19
    laser_rays: int = 541
    laser_field: float = math.radians(270)
    laser_min: float = 0.05
    laser_max: float = 25.0
    laser_noise: float = 0.01
    laser_lost: float = 0.002
    sonar_angles: tuple[float, ...] = (math.radians(20), math.radians(-20), math.radians(160), math.radians(-160))
    sonar_cone: float = math.radians(25)
    sonar_min: float = 0.10
    sonar_max: float = 5.0
    sonar_noise: float = 0.02
    way_scale: float = 0.01
    turn_scale: float = 0.02
    slip: float = 0.01
    turn_slip: float = 0.02
    drift: float = 0.01
    rear: RearParams | None = None

    @property
    def circumscribed(self) -> float:
        """Radius of the circle about the middle that holds all of the body [m]."""
        ends = ((self.length, self.width - 2 * self.corner), (self.length - 2 * self.corner, self.width))
        return max(math.hypot(x, y) for x, y in ends) / 2

    def footprint(self) -> tuple[tuple[float, float], ...]:
        """Corners of the outline [m], counterclockwise, x forward."""
        x, y, c = self.length / 2, self.width / 2, self.corner
        right = ((x - c, -y), (x, -y + c), (x, y - c), (x - c, y))
        return (*right, *((-a, -b) for a, b in right))


class Motion(NamedTuple):
    """Velocity of the body: forward [m/s], to the left [m/s], turning [rad/s]."""

    forward: float
    left: float
    turning: float


class Drive:
    """Ramps a commanded velocity, and pushes until the body has it."""

    def __init__(self, params: RobotParams) -> None:
        self._params = params
        self._linear = self._angular = 0.0

    def stand(self) -> None:
        """Forget what was commanded: the robot was put somewhere else."""
        self._linear = self._angular = 0.0

    def ramp(self, linear: float, angular: float, dt: float) -> None:
        """Bring the wanted velocity nearer to the command [m/s, rad/s]; what is no number is a standstill."""
        p = self._params
        self._linear = _towards(self._linear, linear, p.max_speed, p.acceleration * dt)
        self._angular = _towards(self._angular, angular, p.max_turn, p.turn_acceleration * dt)

    def force(self, motion: Motion) -> Motion:
        """Forward and sideways [N] and about the vertical axis [N m], in the body's frame."""
        p = self._params
        inertia = p.mass * (p.length**2 + p.width**2) / 12
        return Motion(
            _limited((self._linear - motion.forward) * p.mass / p.time_constant, p.push),
            _limited(-motion.left * p.mass / p.time_constant, p.grip),
            _limited((self._angular - motion.turning) * inertia / p.time_constant, p.twist),
        )


class Odometer:
    """Dead reckoning of a robot that began at the origin of its odometry frame."""

    def __init__(self, params: RobotParams, random: np.random.Generator) -> None:
        self._params = params
        self._random = random
        self._way_scale = 1.0 + params.way_scale * float(random.normal())
        self._turn_scale = 1.0 + params.turn_scale * float(random.normal())
        self.pose = ORIGIN
        self.motion = Motion(0.0, 0.0, 0.0)
        """As the wheels' encoders say."""

    def roll(self, way: float, turn: float, dt: float) -> None:
        """The wheels rolled so far forward [m] and turned so much [rad] within dt seconds."""
        p, (along, by_turn, by_way) = self._params, self._random.normal(size=3).tolist()
        way_told = way * self._way_scale + along * p.slip * math.sqrt(abs(way))
        turn_told = turn * self._turn_scale + by_turn * p.turn_slip * math.sqrt(abs(turn))
        turn_told += by_way * p.drift * math.sqrt(abs(way))
        x, y, heading = self.pose
        middle = heading + turn_told / 2
        self.pose = Pose(
            x + way_told * math.cos(middle),
            y + way_told * math.sin(middle),
            math.remainder(heading + turn_told, math.tau),
        )
        self.motion = Motion(way / dt * self._way_scale, 0.0, turn / dt * self._turn_scale)


def _towards(value: float, wanted: float, limit: float, step: float) -> float:
    goal = _limited(wanted, limit) if math.isfinite(wanted) else 0.0
    return value + _limited(goal - value, step)


def _limited(value: float, limit: float) -> float:
    return min(max(value, -limit), limit)
