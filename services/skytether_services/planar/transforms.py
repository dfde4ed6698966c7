"""Poses in the plane, one after the other; `poses` does the same for arrays of them."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from .geometry import Pose, wrap


def compose(first: Pose, then: Pose) -> Pose:
    """The pose that is ``then`` in the frame of ``first``."""
    cos, sin = math.cos(first.yaw), math.sin(first.yaw)
    return Pose(
        first.x + cos * then.x - sin * then.y, first.y + sin * then.x + cos * then.y, wrap(first.yaw + then.yaw)
    )


def inverse(pose: Pose) -> Pose:
    """The pose of the frame in which ``pose`` was given, seen from there."""
    cos, sin = math.cos(pose.yaw), math.sin(pose.yaw)
    return Pose(-cos * pose.x - sin * pose.y, sin * pose.x - cos * pose.y, wrap(-pose.yaw))


def step(start: Pose, end: Pose) -> Pose:
    """The way from one pose to another, in the frame of the first."""
    return compose(inverse(start), end)


def as_array(pose: Pose) -> NDArray[np.float64]:
    """For the algorithms that work on arrays."""
    return np.array(pose, dtype=np.float64)


def as_pose(values: NDArray[np.float64]) -> Pose:
    """Back again."""
    return Pose(float(values[0]), float(values[1]), float(values[2]))
