"""Wheels with a dead time, a lag, late and noisy odometry, and faults."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from random import Random

from skytether.guard.velocity import STANDSTILL, Velocity
from skytether.messages import Header, Odometry, Time, Twist, TwistWithCovariance, Vector3
from skytether.robot.safety.rules.motion import MotionParams

_NOISE = Velocity(MotionParams().linear_tolerance, MotionParams().angular_tolerance)


def odometry(linear: float, angular: float, at: float) -> Odometry:
    stamp = Time(sec=int(at), nanosec=int(at % 1 * 1e9))
    twist = Twist(linear=Vector3(x=linear), angular=Vector3(z=angular))
    return Odometry(header=Header(stamp=stamp), twist=TwistWithCovariance(twist=twist))


@dataclass
class Wheels:
    """First order after a dead time, seen late and with noise; a fault replaces what they do."""

    dead_s: float = 0.1
    lag_s: float = 0.1
    latency_s: float = 0.05
    noise: float = 0.8
    """Share of the default tolerances of the gate."""
    seed: int = 0
    fault: Callable[[Velocity], Velocity] | None = None
    velocity: Velocity = STANDSTILL
    told: list[tuple[float, Velocity]] = field(default_factory=list)
    shown: list[tuple[float, Velocity]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.random = Random(self.seed)

    def write(self, velocity: Velocity, now: float) -> None:
        self.told.append((now, velocity))

    def roll(self, now: float, dt: float) -> None:
        felt = _newest(self.told, now - self.dead_s)
        part = 1 - math.exp(-dt / self.lag_s) if self.lag_s else 1.0
        self.velocity = Velocity(*(old + (new - old) * part for old, new in zip(self.velocity, felt, strict=True)))
        self.shown.append((now, self.fault(self.velocity) if self.fault else self.velocity))

    def reading(self, now: float) -> Velocity:
        seen = _newest(self.shown, now - self.latency_s)
        return Velocity(
            seen.linear + self.noise * _NOISE.linear * self.random.uniform(-1, 1),
            seen.angular + self.noise * _NOISE.angular * self.random.uniform(-1, 1),
        )


def _newest(history: list[tuple[float, Velocity]], until: float) -> Velocity:
    for at, velocity in reversed(history):
        if at <= until + 1e-9:
            return velocity
    return STANDSTILL
