"""The next scan, matched against what the scans before it saw; mapping and localisation follow the robot with it."""

from __future__ import annotations

import numpy as np

from .patch import Patch
from .poses import compose
from .scan_matching import Fit, Floats, rate, refine, search, thin

FEWEST = 10
"""Points that a scan must have to be matched."""


def odometry_information(motion: Floats, per_metre: float, per_radian: float) -> Floats:
    """Information of a motion by odometry, in the frame where it began, 3 by 3.

    Args:
        motion: x [m], y [m], theta [rad].
        per_metre: Error of the odometry's motion [m/m].
        per_radian: Error of its turn [rad/rad].
    """
    size, turn = float(np.hypot(motion[0], motion[1])), abs(float(motion[2]))
    # The laser is not where the robot turns about: 0.2 m off.
    sigma = 0.01 + per_metre * size + 0.2 * turn
    sigma_turn = 0.005 + per_radian * turn + 0.02 * size
    return np.diag([sigma**-2, sigma**-2, sigma_turn**-2])


def turned(information: Floats, angle: float) -> Floats:
    """Information of the map frame in one that is turned by the angle."""
    cos, sin = np.cos(angle), np.sin(angle)
    turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    result: Floats = turn.T @ information @ turn
    return result


def match_next(
    patch: Patch,
    points: Floats,
    pose: Floats,
    motion: Floats,
    prior: Floats,
    reach: tuple[float, float],
    trusted: float | None,
) -> Fit:
    """Match the next scan, from where odometry, or the velocity before, says that it was taken.

    Args:
        patch: What the scans before it saw.
        points: n by (x, y, nx, ny) in the frame of the laser.
        pose: Of the scan before it.
        motion: Since then, in the frame of that pose.
        prior: Information of the motion, in the same frame.
        reach: Window around the guess that is searched where the guess leads nowhere [m, rad].
        trusted: With this overlap a match from the guess is good enough; None: it is always searched.
    """
    guess = compose(pose, motion)
    if len(points) < FEWEST:
        return Fit(guess, np.zeros((3, 3)), 0.0, 0.0)
    held = turned(prior, -pose[2])
    fit = refine(patch, points, guess, held)
    if trusted is not None and fit.overlap > trusted:
        return fit
    start, _ = search(patch, thin(points, 0.1), guess, *reach)
    other = refine(patch, points, start, held * 0.01)
    return other if rate(patch, points, other.pose) > rate(patch, points, fit.pose) else fit
