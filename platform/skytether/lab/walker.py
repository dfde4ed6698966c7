"""Simulated smart walker (Mello, thesis, section 2.4): two driven wheels, encoders, two forearm force sensors.

The motors follow a velocity command with a first-order lag of 100 ms; sampled every 10 ms. They are stiff but not
rigid: the person's push and twist add a little to what is commanded. That is what makes a person with another way in
mind a disturbance to the guidance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from skytether.control.admittance import STANDSTILL, Velocity

from .trail import ORIGIN, Pose


@dataclass(frozen=True, slots=True)
class WalkerParams:
    """The machine.

    Attributes:
        time_constant: Of the response to a velocity command [s] (thesis section 2.4).
        give: Velocity that a push of both arms adds [m/s per N].
        turn_give: Angular velocity that a twist adds [rad/s per N m].
        wheel_radius: [m].
        track: Distance between the driven wheels [m].
        sensor_distance: Distance d between the two forearm sensors [m] (thesis eq. 2.4).
        encoder_step: Wheel angle of one count [rad].
        slip: Standard deviation of a wheel's way on the floor per square root of metre rolled [m^0.5].
        force_noise: Standard deviation of one force sample of one sensor [N].
        force_step: Resolution of a force sensor [N].
    """

    time_constant: float = 0.1
    give: float = 0.0004
    turn_give: float = 0.03
    wheel_radius: float = 0.1
    track: float = 0.55
    sensor_distance: float = 0.5
    encoder_step: float = math.tau / 4000
    slip: float = 0.0003
    force_noise: float = 0.8
    force_step: float = 0.05


class Arms(NamedTuple):
    """Forward forces of the person on the left and on the right forearm support [N]."""

    left: float
    right: float


class WheelState(NamedTuple):
    """What the encoders say: accumulated angles [rad] and their rates over the last step [rad/s]."""

    left: float
    right: float
    left_rate: float
    right_rate: float


class Walker:
    """The plant. Randomness comes from the generator alone."""

    def __init__(self, params: WalkerParams, random: np.random.Generator) -> None:
        """Stands still at the origin, heading along x."""
        self.params = params
        self._random = random
        self.pose = ORIGIN
        """True pose."""
        self.velocity = STANDSTILL
        """True velocity."""
        self._angles = (0.0, 0.0)
        self.wheels = WheelState(0.0, 0.0, 0.0, 0.0)
        self.odometry = ORIGIN
        """Pose by the walker's own dead reckoning from its encoders."""

    def step(self, command: Velocity, arms: Arms, dt: float) -> None:
        """Move for dt seconds under a constant command and constant forces of the person."""
        p = self.params
        answer = -math.expm1(-dt / p.time_constant)
        push, twist = arms.left + arms.right, (arms.right - arms.left) * p.sensor_distance / 2
        if command == STANDSTILL:
            push = twist = 0.0  # the brake holds
        self.velocity = Velocity(
            self.velocity.linear + (command.linear + p.give * push - self.velocity.linear) * answer,
            self.velocity.angular + (command.angular + p.turn_give * twist - self.velocity.angular) * answer,
        )
        half = self.velocity.angular * p.track / 2
        left, right = (self.velocity.linear - half) * dt, (self.velocity.linear + half) * dt
        self._angles = (self._angles[0] + left / p.wheel_radius, self._angles[1] + right / p.wheel_radius)
        slip_left, slip_right = self._random.normal(size=2) * p.slip
        self.pose = _rolled(
            self.pose,
            left + slip_left * math.sqrt(abs(left)),
            right + slip_right * math.sqrt(abs(right)),
            p.track,
        )
        before = self.wheels
        left_angle, right_angle = (math.floor(a / p.encoder_step) * p.encoder_step for a in self._angles)
        self.wheels = WheelState(
            left_angle, right_angle, (left_angle - before.left) / dt, (right_angle - before.right) / dt
        )
        self.odometry = _rolled(
            self.odometry,
            (left_angle - before.left) * p.wheel_radius,
            (right_angle - before.right) * p.wheel_radius,
            p.track,
        )

    def measure(self, arms: Arms) -> Arms:
        """What the force sensors read."""
        p = self.params
        noise = self._random.normal(size=2) * p.force_noise
        left, right = (round((f + n) / p.force_step) * p.force_step for f, n in zip(arms, noise, strict=True))
        return Arms(left, right)


def _rolled(pose: Pose, left: float, right: float, track: float) -> Pose:
    """Midpoint integration; over one step of 10 ms the arc and its chord differ by nanometres."""
    way, turn = (left + right) / 2, (right - left) / track
    middle = pose.heading + turn / 2
    return Pose(pose.x + way * math.cos(middle), pose.y + way * math.sin(middle), pose.heading + turn)
