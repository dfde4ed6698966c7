"""Where a face points, from its landmarks.

Landmarks come in pairs that mirror each other: the line through a pair is the head's own left-right axis. Its depth
comes from a network that saw heads turn less than they did, so the angle is scaled by what was measured
(``skytether lab bench face``).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

PAIRS = ((33, 263), (133, 362), (61, 291), (127, 356), (234, 454), (93, 323), (70, 300), (105, 334), (205, 425))
"""Landmarks of the person's right and left that mirror each other: eyes, mouth, sides, brows, cheeks."""
_RIGHT, _LEFT = (list(side) for side in zip(*PAIRS, strict=True))


_SLOPE = 0.83
"""What the network shows of a turn: 0.81 to 0.86 at 0.9 to 2 m."""


def turned(points: NDArray[np.float64], slope: float = _SLOPE) -> float:
    """Angle of a face off the line from it to the camera, positive to the right of the picture [rad].

    Args:
        points: Landmarks, n by (x, y, z): x to the right, z away from the camera.
        slope: What is seen of a turn.
    """
    across = points[_LEFT] - points[_RIGHT]
    return math.atan2(float(across[:, 2].sum()), float(np.hypot(across[:, 0], across[:, 1]).sum())) / slope
