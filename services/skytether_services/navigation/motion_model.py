"""Poses in the plane, and the odometry motion model with noise (Thrun, Burgard, Fox: Probabilistic Robotics, 5.4)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class OdometryNoise:
    """Variances of odometry, as nav2_amcl names them; ``floor`` keeps particles apart where the robot hardly moves.

    Attributes:
        alpha1: Of a rotation, per rotation [rad²/rad²].
        alpha2: Of a rotation, per translation [rad²/m²].
        alpha3: Of a translation, per translation [m²/m²].
        alpha4: Of a translation, per rotation [m²/rad²].
        floor_position: Least standard deviation of a step along each axis [m].
        floor_heading: Least standard deviation of a step's heading [rad].
    """

    alpha1: float = 0.04
    alpha2: float = 0.01
    alpha3: float = 0.04
    alpha4: float = 0.002
    floor_position: float = 0.005
    floor_heading: float = 0.003


def wrap(angle: Array) -> Array:
    """The same angles in [-pi, pi)."""
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi, dtype=np.float64)


def compose(pose: Array, step: Array) -> Array:
    """The poses after steps that are given in their own frames; both end in (3,) and broadcast."""
    cos, sin = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    x = pose[..., 0] + cos * step[..., 0] - sin * step[..., 1]
    y = pose[..., 1] + sin * step[..., 0] + cos * step[..., 1]
    return np.stack((x, y, wrap(pose[..., 2] + step[..., 2])), axis=-1)


def between(start: Array, end: Array) -> Array:
    """The step that leads from one pose to another, in the frame of the first."""
    cos, sin = np.cos(start[..., 2]), np.sin(start[..., 2])
    dx, dy = end[..., 0] - start[..., 0], end[..., 1] - start[..., 1]
    return np.stack((cos * dx + sin * dy, cos * dy - sin * dx, wrap(end[..., 2] - start[..., 2])), axis=-1)


def step_deviations(step: Array, noise: OdometryNoise) -> tuple[float, float, float]:
    """Standard deviations of a step: along it [m], across it [m], of its heading [rad].

    The two rotations of Thrun's model lie within one step of some centimetres; so its first rotation shows as a
    deviation across, and both add to the heading. A robot that drives backwards has not turned round twice.
    """
    distance, turn = float(np.hypot(step[0], step[1])), abs(float(step[2]))
    heading = np.sqrt(noise.alpha1 * turn**2 + noise.alpha2 * distance**2 + noise.floor_heading**2)
    along = np.sqrt(noise.alpha3 * distance**2 + noise.alpha4 * turn**2 + noise.floor_position**2)
    across = np.sqrt((distance * heading / 2) ** 2 + noise.alpha4 * turn**2 + noise.floor_position**2)
    return float(along), float(across), float(heading)


def move_particles(particles: Array, step: Array, noise: OdometryNoise, random: np.random.Generator) -> Array:
    """Particles after a step, each with an error of its own.

    Args:
        particles: n by 3: x [m], y [m], heading [rad].
        step: What odometry says, in the robot's frame before it: x [m], y [m], heading [rad].
        noise: How much odometry errs.
        random: Where the errors come from.
    """
    along, across, heading = step_deviations(step, noise)
    errors = random.standard_normal((len(particles), 3))
    direction = np.arctan2(step[1], step[0])
    cos, sin = np.cos(direction), np.sin(direction)
    steps = np.empty_like(errors)
    steps[:, 0] = step[0] + cos * along * errors[:, 0] - sin * across * errors[:, 1]
    steps[:, 1] = step[1] + sin * along * errors[:, 0] + cos * across * errors[:, 1]
    steps[:, 2] = step[2] + heading * errors[:, 2]
    return compose(particles, steps)
