"""From one velocity to the next, never faster than the robot may: slowing down on the way it is on. Pure.

What a command may ask of the wheels is the supervisor's business; here is what a zone may ask of them. Only the
standard library is used, so that the guard can use it too.
"""

from __future__ import annotations

from math import inf
from typing import Protocol

from skytether.control.admittance import STANDSTILL, Velocity

_ROUNDING = 1e-9


class Rates(Protocol):
    """How fast velocities may change; `skytether.robot.control.supervisor.VelocityLimits` has them [m/s^2, rad/s^2]."""

    @property
    def linear_acceleration(self) -> float:
        """Of ordinary changes."""
        ...

    @property
    def angular_acceleration(self) -> float:
        """Of ordinary changes."""
        ...

    @property
    def linear_braking(self) -> float:
        """Towards a standstill."""
        ...

    @property
    def angular_braking(self) -> float:
        """Towards a standstill."""
        ...


def slowdown(limits: Rates, velocity: Velocity) -> float:
    """How fast a velocity can be scaled down while the robot stays on its curve [1/s]; inf at a standstill."""
    linear, angular = abs(velocity.linear), abs(velocity.angular)
    return min(
        limits.linear_braking / linear if linear else inf,
        limits.angular_braking / angular if angular else inf,
    )


def brake_on_curve(limits: Rates, velocity: Velocity, dt: float) -> Velocity:
    """The next velocity of the fastest stop that keeps the curvature."""
    if velocity == STANDSTILL:
        return STANDSTILL
    left = max(0.0, 1.0 - slowdown(limits, velocity) * dt)
    return Velocity(velocity.linear * left, velocity.angular * left)


def within_reach(limits: Rates, before: Velocity, after: Velocity, dt: float) -> bool:
    """Whether the wheels may be told ``after``, ``dt`` seconds after ``before``."""
    return _reach(before.linear, after.linear, limits.linear_acceleration, limits.linear_braking, dt) and _reach(
        before.angular, after.angular, limits.angular_acceleration, limits.angular_braking, dt
    )


def _reach(before: float, after: float, acceleration: float, braking: float, dt: float) -> bool:
    if before < 0:
        before, after = -before, -after
    if after >= before:
        return after - before <= acceleration * dt + _ROUNDING
    if after >= 0:
        return before - after <= braking * dt + _ROUNDING
    return before / braking - after / acceleration <= dt + _ROUNDING
