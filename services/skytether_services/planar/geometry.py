"""Poses in the plane."""

from __future__ import annotations

import math
from typing import NamedTuple


class Pose(NamedTuple):
    """Where a robot is: x [m], y [m], yaw [rad], positive to the left."""

    x: float
    y: float
    yaw: float


def wrap(angle: float) -> float:
    """The same angle in [-pi, pi) [rad]."""
    return (angle + math.pi) % math.tau - math.pi


def advance(pose: Pose, linear: float, angular: float, dt: float) -> Pose:
    """The pose after driving with constant velocities [m/s, rad/s] for dt [s]: an arc, exactly."""
    turn = angular * dt
    # sin(a/2)/(a/2) tends to 1: the chord of a short arc is the arc.
    chord = linear * dt * (math.sin(turn / 2) / (turn / 2) if abs(turn) > 1e-9 else 1.0)
    heading = pose.yaw + turn / 2
    return Pose(pose.x + chord * math.cos(heading), pose.y + chord * math.sin(heading), wrap(pose.yaw + turn))
