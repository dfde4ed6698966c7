"""The robot's motion by wheels and laser, in the room of `test_scan_matching`. Its functions compile for a while."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from skytether_services.navigation.poses import between, compose
from skytether_services.navigation.scan_matching import scan_points, with_normals
from skytether_services.navigation.scan_odometry import ScanOdometry, ScanOdometryParams

from .test_scan_matching import ANGLES, room

pytestmark = pytest.mark.slow


def drive(count: int) -> list[NDArray[np.float64]]:
    """A curve to the left, 0.1 m and 0.05 rad a step."""
    poses = [np.array([-1.0, -1.0, 0.0])]
    for _ in range(count):
        poses.append(compose(poses[-1], np.array([0.1, 0.0, 0.05])))
    return poses


def test_wheels_that_err_are_put_right() -> None:
    truth, random = drive(25), np.random.default_rng(1)
    odometry = ScanOdometry()
    odometry.update(np.zeros(3), scan_points(room(truth[0]), ANGLES, 30.0))
    for before, after in pairwise(truth):
        step = between(before, after) * (1 + 0.2 * random.standard_normal(3))
        moved = odometry.update(step, scan_points(room(after), ANGLES, 30.0))
        assert not moved.broken
        assert moved.overlap > 0.8
    # 25 steps whose lengths err by 2 cm each would be 10 cm off.
    np.testing.assert_allclose(odometry.pose, between(truth[0], truth[-1]), atol=0.02)
    assert np.sqrt(moved.covariance[0, 0]) < 0.02


def test_scans_that_continue_nothing_break_it_and_then_it_goes_on() -> None:
    odometry = ScanOdometry()
    odometry.update(np.zeros(3), scan_points(room(np.zeros(3)), ANGLES, 30.0))
    # A circle of 1 m around the laser, which no wall of the room is.
    pillar = scan_points(np.full(len(ANGLES), 1.0, np.float32), ANGLES, 30.0)
    broken = [odometry.update(np.zeros(3), pillar).broken for _ in range(odometry.params.strange + 1)]
    assert broken == [False] * (odometry.params.strange - 1) + [True, False]
    # The room was forgotten, and is still counted.
    assert (len(odometry.keys), odometry.kept) == (1, 2)


def test_scans_that_were_dropped_are_not_matched_with() -> None:
    truth = drive(60)
    odometry = ScanOdometry(ScanOdometryParams(key_scans=4, near_scans=2))
    odometry.update(np.zeros(3), scan_points(room(truth[0]), ANGLES, 30.0))
    for before, after in pairwise(truth):
        moved = odometry.update(between(before, after), scan_points(room(after), ANGLES, 30.0))
        assert moved.overlap > 0.6
    assert len(odometry.keys) == 4
    assert odometry.kept > 12
    np.testing.assert_allclose(odometry.pose, between(truth[0], truth[-1]), atol=0.05)


def test_normals_do_not_depend_on_where_the_robot_has_its_laser() -> None:
    scan = scan_points(room(np.zeros(3)), ANGLES, 30.0)
    np.testing.assert_allclose(with_normals(scan[:, :2], np.zeros(2)), scan, atol=1e-9)
    shifted = with_normals(scan[:, :2] + np.array([0.2, 0.0]), np.array([0.2, 0.0]))
    np.testing.assert_allclose(shifted, scan + np.array([0.2, 0.0, 0.0, 0.0]), atol=1e-6)
