"""Odometry made better by the laser: each scan is matched with what the scans before it saw near by.

It needs no map, so it goes on where the map ends; and it says when scans do not continue what was seen before, as when
the robot was carried away.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skytether_services.navigation.patch import Patch, PatchMemory, make_patch
from skytether_services.navigation.poses import between, compose
from skytether_services.navigation.scan_following import FEWEST, match_next, odometry_information, turned
from skytether_services.navigation.scan_matching import moved, thin

Array = NDArray[np.float64]

_INDEPENDENT = 0.1
"""Part of a scan's points that err independently of their neighbours."""
_RECENT = 5
"""Scans before one that it is compared with, by how well they continued what was seen."""
_FLOOR = np.diag([0.005**2, 0.005**2, 0.0015**2])
"""Covariance of a perfect match [m², rad²]."""


@dataclass(frozen=True)
class ScanOdometryParams:
    """How scans are matched with those before.

    Attributes:
        odometry_m: Error of the wheels' motion, for each metre [m/m].
        odometry_rad: Error of their turn, for each radian [rad/rad].
        key_distance: A scan is kept after so much motion [m].
        key_turn: Or after so much turning [rad].
        key_scans: So many scans are kept: with them a room that was left is known when the robot comes back.
        near_scans: So many of them, the nearest, are what the next scan is matched with.
        continues: Share of the points on surfaces that have to lie on what was seen before, for a scan to continue it.
        trusted: With this share a match from where the wheels say is good enough; below it, others are looked for.
        jump: A scan jumped whose share is less than this part of that of the scans just before.
        strange: After so many scans on end that do not continue it, what was seen before is forgotten.
    """

    odometry_m: float = 0.1
    odometry_rad: float = 0.1
    key_distance: float = 0.2
    key_turn: float = 0.15
    key_scans: int = 300
    near_scans: int = 40
    continues: float = 0.3
    trusted: float = 0.3
    jump: float = 0.5
    strange: int = 4


@dataclass(frozen=True)
class KeyScan:
    """A scan that was kept.

    Attributes:
        pose: Of the robot, in the frame of this odometry: x [m], y [m], heading [rad].
        points: n by (x, y, nx, ny), in the robot's frame then [m].
        placed: The same in the frame of this odometry.
    """

    pose: Array
    points: Array
    placed: Array


@dataclass(frozen=True)
class ScanStep:
    """A step of the robot by wheels and laser.

    Attributes:
        motion: In the robot's frame before it: x [m], y [m], heading [rad].
        covariance: Of it, 3 by 3 [m², rad²].
        overlap: Share of the scan's points on surfaces that lie on what was seen before; 1 if there is nothing to
            compare with.
        broken: Whether what was seen before was forgotten, because too many scans did not continue it.
        matched: Whether the motion is by a match of scans; else it is the wheels'.
        jumped: Whether the scan is the first that continues what was seen before much less than those before it, as
            when the robot was carried away.
        usual: Median overlap of those scans; 0 where they are too few.
    """

    motion: Array
    covariance: Array
    overlap: float
    broken: bool
    matched: bool
    jumped: bool
    usual: float


def usual_overlap(before: Sequence[float]) -> float:
    """Median overlap of the scans just before; 0 where they are too few."""
    return sorted(before)[len(before) // 2] if len(before) >= _RECENT else 0.0


class ScanOdometry:
    """The robot's motion by wheels and laser.

    Attributes:
        pose: x [m], y [m], heading [rad], from where it began.
        keys: The scans that are kept, oldest first.
        kept: So many were kept since it was made, those included that were dropped or forgotten.
    """

    def __init__(self, params: ScanOdometryParams | None = None) -> None:
        self.params = params or ScanOdometryParams()
        self.pose: Array = np.zeros(3)
        self.keys: deque[KeyScan] = deque(maxlen=self.params.key_scans)
        self.kept = 0
        self._patch: Patch | None = None
        self._memory = PatchMemory()
        self._poses: Array = np.zeros((0, 3))
        self._last: Array = np.zeros(3)
        self._strange = 0
        self._overlaps: deque[float] = deque(maxlen=_RECENT)

    def forget(self) -> None:
        """Begin anew: the next scan continues nothing."""
        self.keys.clear()
        self._poses = np.zeros((0, 3))
        self._patch = None
        self._strange = 0
        self._overlaps.clear()

    def update(self, step: Array, points: Array) -> ScanStep:
        """Take a step of the wheels and the scan after it.

        Args:
            step: In the robot's frame before it: x [m], y [m], heading [rad].
            points: n by (x, y, nx, ny): the scan in the robot's frame [m].
        """
        params = self.params
        before = self.pose
        prior = odometry_information(step, params.odometry_m, params.odometry_rad)
        motion, covariance = step, np.asarray(np.linalg.inv(prior), np.float64)
        overlap, broken, matched = 1.0, False, False
        if self._patch is not None and len(points) >= FEWEST:
            reach = (0.1 + 0.5 * math.hypot(step[0], step[1]), 0.05 + 0.5 * abs(float(step[2])))
            # Only points on a surface can lie on one.
            on_surfaces = max(float(np.any(points[:, 2:] != 0, axis=1).mean()), 0.1)
            held = prior / _INDEPENDENT
            fit = match_next(self._patch, points, before, step, held, reach, params.trusted * on_surfaces)
            overlap = fit.overlap / on_surfaces
            if overlap >= params.continues:
                self._strange, matched = 0, True
                motion = between(before, fit.pose)
                information = turned(fit.information, float(before[2])) * _INDEPENDENT
                covariance = np.asarray(np.linalg.inv(information) + _FLOOR, np.float64)
            else:
                self._strange += 1
                broken = self._strange >= params.strange
        self.pose = compose(before, motion)
        if broken:
            self.forget()
        if not self._strange and len(points) >= FEWEST:
            self._keep(points)
        usual = usual_overlap(self._overlaps)
        least = params.jump * usual
        jumped = overlap < least <= self._overlaps[-1] if usual else False
        if len(points) >= FEWEST:
            self._overlaps.append(overlap)
        return ScanStep(motion, covariance, overlap, broken, matched, jumped, usual)

    def _keep(self, points: Array) -> None:
        params = self.params
        if self.keys:
            away = between(self._last, self.pose)
            if math.hypot(away[0], away[1]) < params.key_distance and abs(away[2]) < params.key_turn:
                return
        self._last = self.pose
        thinned = thin(points, 0.05)
        self.keys.append(KeyScan(self.pose, thinned, moved(thinned, self.pose)))
        self.kept += 1
        # Of the keys, in their order.
        self._poses = np.vstack((self._poses[max(len(self._poses) + 1 - params.key_scans, 0) :], self.pose))
        far = np.hypot(self._poses[:, 0] - self.pose[0], self._poses[:, 1] - self.pose[1])
        near = np.argsort(far, kind="stable")[: params.near_scans]
        self._patch = make_patch(np.vstack([self.keys[index].placed for index in near]), memory=self._memory)
