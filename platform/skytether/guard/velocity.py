"""A velocity of the robot's base."""

from __future__ import annotations

from typing import NamedTuple


class Velocity(NamedTuple):
    """Velocity of the robot's base: forward [m/s], and about the vertical axis [rad/s], positive to the left."""

    linear: float
    angular: float


STANDSTILL = Velocity(0.0, 0.0)
