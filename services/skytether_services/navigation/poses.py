"""Poses in the plane as arrays whose last axis is x [m], y [m], heading [rad] in [-pi, pi)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


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
