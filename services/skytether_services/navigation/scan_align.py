"""Fine alignment of a scan with obstacles, by Gauss and Newton on their distance field.

It minimises the robust squared distances of the scan's points from obstacles (Welsch's weights, so that points without
an obstacle near them do not count) together with the distance from a first guess, by that guess's information: along a
corridor, where the scan says nothing, the guess stays.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from skytether_services.navigation.compiled import compiled

Array = NDArray[np.float64]


@compiled
def align(
    distance: NDArray[np.float32],
    points: Array,
    guess: Array,
    information: Array,
    sigma: float,
    weight: float,
    iterations: int,
) -> tuple[Array, Array, float]:
    """Move a pose to where points fit best.

    Args:
        distance: Rows by columns; distance of each cell's middle from the nearest obstacle [cells].
        points: n by 2, in the frame of the pose [cells].
        guess: Column, row [cells], heading [rad].
        information: 3 by 3: inverse covariance of the guess [1/cells², 1/rad²].
        sigma: Standard deviation of a point from its obstacle [cells].
        weight: What one point counts; below 1, for neighbouring beams err alike.
        iterations: How often at most.

    Returns:
        The pose, its information, and the share of the points that are within 2 sigma of an obstacle.
    """
    rows, columns = distance.shape
    pose = guess.copy()
    matrix = information.copy()
    near = 0
    for _ in range(iterations):
        matrix = information.copy()
        vector = information @ (guess - pose)
        cos, sin = math.cos(pose[2]), math.sin(pose[2])
        near = 0
        for index in range(points.shape[0]):
            px = cos * points[index, 0] - sin * points[index, 1]
            py = sin * points[index, 0] + cos * points[index, 1]
            x, y = pose[0] + px - 0.5, pose[1] + py - 0.5
            column, row = math.floor(x), math.floor(y)
            if not (0 <= column < columns - 1 and 0 <= row < rows - 1):
                continue
            fx, fy = x - column, y - row
            d00, d01 = distance[row, column], distance[row, column + 1]
            d10, d11 = distance[row + 1, column], distance[row + 1, column + 1]
            d = (1 - fy) * ((1 - fx) * d00 + fx * d01) + fy * ((1 - fx) * d10 + fx * d11)
            if d > 4 * sigma:
                continue
            if d < 2 * sigma:
                near += 1
            gx = (1 - fy) * (d01 - d00) + fy * (d11 - d10)
            gy = (1 - fx) * (d10 - d00) + fx * (d11 - d01)
            gt = -gx * py + gy * px
            factor = weight * math.exp(-d * d / (2 * sigma * sigma)) / (sigma * sigma)
            matrix[0, 0] += factor * gx * gx
            matrix[0, 1] += factor * gx * gy
            matrix[0, 2] += factor * gx * gt
            matrix[1, 1] += factor * gy * gy
            matrix[1, 2] += factor * gy * gt
            matrix[2, 2] += factor * gt * gt
            vector[0] -= factor * gx * d
            vector[1] -= factor * gy * d
            vector[2] -= factor * gt * d
        matrix[1, 0], matrix[2, 0], matrix[2, 1] = matrix[0, 1], matrix[0, 2], matrix[1, 2]
        step = np.linalg.solve(matrix, vector)
        pose += step
        if abs(step[0]) + abs(step[1]) < 0.01 and abs(step[2]) < 1e-4:
            break
    return pose, matrix, near / max(points.shape[0], 1)
