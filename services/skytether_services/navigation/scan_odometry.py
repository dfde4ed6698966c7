"""Odometry made better by the laser: each scan is aligned with what the last few metres showed.

It needs no map, so it goes on where the map ends; and it says when a scan does not continue what was seen before, as
when the robot was carried away.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from skytether_services.navigation.motion_model import OdometryNoise, between, compose, step_deviations
from skytether_services.navigation.scan_align import align

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ScanOdometryParams:
    """How scans are aligned with each other.

    Attributes:
        resolution: Side of a cell of what was seen last [m].
        half_size: It reaches so far from the robot [m].
        sigma: Standard deviation of a point from an obstacle [m].
        point_weight: What one point counts beside odometry; neighbouring points err alike.
        key_distance: A scan is kept after so much motion [m].
        key_turn: Or after so much turning [rad].
        key_scans: So many scans are kept.
        continues: Share of points that have to be near what was seen last, for a scan to continue it.
        iterations: Of the alignment.
    """

    resolution: float = 0.05
    half_size: float = 8.0
    sigma: float = 0.08
    point_weight: float = 0.2
    key_distance: float = 0.3
    key_turn: float = 0.3
    key_scans: int = 12
    continues: float = 0.3
    iterations: int = 8


@dataclass(frozen=True)
class KeyScan:
    """A scan that was kept.

    Attributes:
        pose: Of the robot, in the frame of this odometry: x [m], y [m], heading [rad].
        points: n by 2, in the robot's frame then [m].
    """

    pose: Array
    points: Array


class ScanOdometry:
    """The robot's motion by wheels and laser.

    Attributes:
        pose: x [m], y [m], heading [rad], from where it began.
        keys: The scans that are kept, oldest first.
    """

    def __init__(self, params: ScanOdometryParams | None = None, noise: OdometryNoise | None = None) -> None:
        self.params = params or ScanOdometryParams()
        self.noise = noise or OdometryNoise()
        self.pose: Array = np.zeros(3)
        self.keys: deque[KeyScan] = deque(maxlen=self.params.key_scans)
        self._distance: NDArray[np.float32] | None = None
        self._corner: Array = np.zeros(2)

    def update(self, step: Array, points: Array) -> tuple[Array, bool]:
        """Take a step of the wheels and the scan after it.

        Args:
            step: In the robot's frame before it: x [m], y [m], heading [rad].
            points: n by 2: the scan in the robot's frame [m].

        Returns:
            The step as the laser corrects it, and whether the scan continues what was seen before. Where it does not,
            what was seen before is forgotten.
        """
        before = self.pose
        guess = compose(before, step)
        continues = True
        if self._distance is not None and len(points):
            cell = self.params.resolution
            information = self._information(step) * np.array([cell, cell, 1.0])
            information *= np.array([[cell], [cell], [1.0]])
            at = np.array([*((guess[:2] - self._corner) / cell), guess[2]])
            found, _, near = align(
                self._distance,
                points / cell,
                at,
                information,
                self.params.sigma / cell,
                self.params.point_weight,
                self.params.iterations,
            )
            continues = near >= self.params.continues
            if continues:
                guess = np.array([*(found[:2] * cell + self._corner), found[2]])
            else:
                self.keys.clear()
        self.pose = guess
        self._keep(points)
        return between(before, guess), continues

    def _information(self, step: Array) -> Array:
        along, across, turn = step_deviations(step, self.noise)
        # The wider of both, so that the direction of the step does not matter.
        wide = max(along, across, 0.02)
        return np.diag([1 / wide**2, 1 / wide**2, 1 / max(turn, 0.01) ** 2])

    def _keep(self, points: Array) -> None:
        if self.keys:
            moved = between(self.keys[-1].pose, self.pose)
            far = math.hypot(moved[0], moved[1]) >= self.params.key_distance
            if not far and abs(moved[2]) < self.params.key_turn:
                return
        self.keys.append(KeyScan(self.pose.copy(), points))
        size = 2 * round(self.params.half_size / self.params.resolution)
        self._corner = self.pose[:2] - self.params.half_size
        empty = np.ones((size, size), np.uint8)
        for key in self.keys:
            cos, sin = math.cos(key.pose[2]), math.sin(key.pose[2])
            turned = key.points @ np.array([[cos, sin], [-sin, cos]]) + key.pose[:2]
            cells = np.floor((turned - self._corner) / self.params.resolution).astype(np.int64)
            inside = ((cells >= 0) & (cells < size)).all(axis=1)
            empty[cells[inside, 1], cells[inside, 0]] = 0
        self._distance = cv2.distanceTransform(empty, cv2.DIST_L2, cv2.DIST_MASK_PRECISE).astype(np.float32)
