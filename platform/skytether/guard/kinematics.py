"""From what the wheels were told last towards what is wanted, never faster than the robot may. Pure.

Both axes take the same share of the way, so that braking keeps the robot on its curve.
"""

from __future__ import annotations

from typing import NamedTuple

from .velocity import STANDSTILL, Velocity


class Bounds(NamedTuple):
    """What the wheels may do: the supervisor's limits, as far as the guard needs them."""

    linear_max: float
    """Fastest forward [m/s]."""
    linear_min: float
    """Fastest backward, 0 or negative [m/s]."""
    angular_max: float
    """Fastest to either side [rad/s]."""
    linear_acceleration: float
    """Getting faster, either way [m/s^2]."""
    angular_acceleration: float
    """Getting faster, either way [rad/s^2]."""
    linear_braking: float
    """Getting slower [m/s^2]."""
    angular_braking: float
    """Getting slower [rad/s^2]."""


def toward(bounds: Bounds, told: Velocity, wanted: Velocity, dt: float) -> Velocity:
    """The velocity that the wheels may be told ``dt`` seconds [s] after ``told``: the largest share of the way."""
    share = min(
        _share(told.linear, wanted.linear, bounds.linear_acceleration * dt, bounds.linear_braking * dt),
        _share(told.angular, wanted.angular, bounds.angular_acceleration * dt, bounds.angular_braking * dt),
    )
    if share >= 1:
        return wanted
    return Velocity(
        told.linear + share * (wanted.linear - told.linear), told.angular + share * (wanted.angular - told.angular)
    )


def brake(bounds: Bounds, told: Velocity, dt: float) -> Velocity:
    """The fastest stop that keeps the curve, one step of ``dt`` seconds [s]."""
    return toward(bounds, told, STANDSTILL, dt)


def _share(before: float, after: float, faster: float, slower: float) -> float:
    """Of the way from ``before`` to ``after``, if one step may get faster or slower by so much."""
    way = abs(after - before)
    if way == 0:
        return 1.0
    if before < 0:
        before, after = -before, -after
    if after >= before:
        most = faster
    elif after >= 0 or slower < before:
        most = slower
    else:  # through standstill: what is left of the step after braking gets faster on the other side
        most = before + (1.0 - before / slower) * faster if slower else 0.0
    return min(1.0, most / way)
