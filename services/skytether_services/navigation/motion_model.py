"""Particles that move as odometry says, each with an error of its own."""

from __future__ import annotations

import numpy as np

from skytether_services.navigation.poses import Array, compose


def move_particles(particles: Array, step: Array, covariance: Array, random: np.random.Generator) -> Array:
    """Particles after a step (Thrun, Burgard, Fox: Probabilistic Robotics, 5.4, with any covariance).

    Args:
        particles: n by 3: x [m], y [m], heading [rad].
        step: In the robot's frame before it: x [m], y [m], heading [rad].
        covariance: Of the step, 3 by 3 [m², rad²].
        random: Where the errors come from.
    """
    errors = random.standard_normal((len(particles), 3)) @ np.linalg.cholesky(covariance).T
    return compose(particles, step + errors)
