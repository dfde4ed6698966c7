"""The functions in a room of 8 by 6 m, whose rays are computed. They compile for a while in a fresh clone."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from skytether_services.navigation.log_odds import occupancy
from skytether_services.navigation.mapping import find_trajectory
from skytether_services.navigation.patch import CELL, PatchMemory, make_patch
from skytether_services.navigation.poses import between
from skytether_services.navigation.scan_matching import moved, rate, refine, scan_points, search, thin

pytestmark = pytest.mark.slow

ANGLES = np.radians(np.arange(-90, 90, 0.5))


def room(pose: NDArray[np.float64], angles: NDArray[np.float64] = ANGLES) -> NDArray[np.float32]:
    """Ranges in a room from (-4, -3) to (4, 3) with a box in the corner (2, 1) to (4, 3)."""
    cos, sin = np.cos(pose[2] + angles), np.sin(pose[2] + angles)
    with np.errstate(divide="ignore", invalid="ignore"):
        walls = np.minimum(
            np.maximum((4 - pose[0]) / cos, (-4 - pose[0]) / cos),
            np.maximum((3 - pose[1]) / sin, (-3 - pose[1]) / sin),
        )
        left = np.where(cos > 0, (2 - pose[0]) / cos, np.inf)
        left = np.where((left > 0) & (pose[1] + left * sin > 1), left, np.inf)
        under = np.where(sin > 0, (1 - pose[1]) / sin, np.inf)
        under = np.where((under > 0) & (pose[0] + under * cos > 2), under, np.inf)
    return np.minimum(walls, np.minimum(left, under)).astype(np.float32)


def test_normals_look_at_the_laser() -> None:
    points = scan_points(room(np.zeros(3)), ANGLES, 30.0)
    # The ray to the right meets the wall y = -3, whose inside looks along y.
    np.testing.assert_allclose(points[0], [0, -3, 0, 1], atol=1e-5)
    ahead = points[180]
    np.testing.assert_allclose(ahead, [4, 0, -1, 0], atol=1e-5)
    known = np.hypot(points[:, 2], points[:, 3]) > 0
    assert known.mean() > 0.9
    assert len(scan_points(np.array([1, np.nan, 30, 0], np.float32), ANGLES[:4], 30.0)) == 1


def test_a_patch_knows_the_nearest_surface_and_how_far_it_is() -> None:
    reach = 5
    patch = make_patch(moved(scan_points(room(np.zeros(3)), ANGLES, 30.0), np.zeros(3)), reach)
    rows, columns = patch.squares.shape
    middles = np.stack(np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5), axis=-1) * CELL + patch.origin
    # The slow way: each cell's middle against each surface.
    squares = ((middles[:, :, None] - patch.surfaces[:, :2]) ** 2).sum(axis=3) / CELL**2
    near = squares.min(axis=2) <= reach**2
    np.testing.assert_allclose(patch.squares[near], squares.min(axis=2)[near], atol=1e-3)
    assert (patch.squares[~near] > reach**2).all()
    assert (patch.nearest[~near] == -1).all()
    found = np.take_along_axis(squares, np.maximum(patch.nearest, 0)[:, :, None].astype(int), axis=2)[:, :, 0]
    np.testing.assert_allclose(found[near], squares.min(axis=2)[near], atol=1e-3)


def test_a_patch_in_used_memory_has_nothing_of_the_one_before_it() -> None:
    points = moved(scan_points(room(np.zeros(3)), ANGLES, 30.0), np.zeros(3))
    memory, part = PatchMemory(), points[:120]
    before = make_patch(points, memory=memory)
    again, alone = make_patch(part, memory=memory), make_patch(part)
    assert np.shares_memory(again.squares, before.squares)
    assert np.shares_memory(again.nearest, before.nearest)
    np.testing.assert_array_equal(again.squares, alone.squares)
    np.testing.assert_array_equal(again.nearest, alone.nearest)
    np.testing.assert_array_equal(again.surfaces, alone.surfaces)
    assert not np.shares_memory(alone.squares, make_patch(part).squares)


def test_of_the_points_in_a_cell_the_first_one_stays() -> None:
    points = np.array(
        [[0.01, 0.01, 1, 0], [-0.01, 0.01, 0, 1], [0.09, 0.02, 0, 1], [0.1, 0.01, 1, 0], [-0.02, 0, 1, 0]]
    )
    np.testing.assert_array_equal(thin(points, 0.1), points[[0, 1, 3]])
    assert len(thin(points[:0], 0.1)) == 0


def test_refined_to_a_millimetre_and_the_search_finds_what_is_far() -> None:
    patch = make_patch(moved(scan_points(room(np.zeros(3)), ANGLES, 30.0), np.zeros(3)))
    truth = np.array([0.3, -0.2, 0.15])
    points = scan_points(room(truth), ANGLES, 30.0)
    fit = refine(patch, points, truth + np.array([0.05, -0.05, 0.02]))
    np.testing.assert_allclose(fit.pose, truth, atol=0.004)
    assert fit.overlap > 0.8
    assert fit.residual < 0.01
    found, score = search(patch, thin(points, 0.1), np.array([1.2, 0.7, -0.2]), 1.5, 0.5)
    np.testing.assert_allclose(found, truth, atol=0.08)
    # Branch and bound cuts nothing off: no pose of the grid scores more.
    assert score == pytest.approx(rate(patch, thin(points, 0.1), found), abs=0.03)
    assert score > 0.9
    none, nothing = search(patch, thin(points, 0.1), np.array([9.0, 9, 0]), 0.5, 0.1, at_least=0.8)
    assert (none.tolist(), nothing) == ([9, 9, 0], 0.0)


def test_a_wall_alone_does_not_hold_what_is_along_it() -> None:
    wall = np.column_stack([np.arange(-3, 3, 0.05), np.full(120, 2.0), np.zeros(120), np.full(120, -1.0)])
    fit = refine(make_patch(wall), wall[30:90], np.array([0.3, 0.06, 0.0]))
    np.testing.assert_allclose(fit.pose, [0.3, 0, 0], atol=1e-3)
    # 60 points of 0.03 m: 60 / 0.0009.
    assert fit.information[1, 1] == pytest.approx(60 / 0.03**2, rel=0.05)
    assert fit.information[0, 0] < 1e-6


def test_beams_free_what_they_cross() -> None:
    grid = occupancy(room(np.zeros(3))[None], ANGLES, 30.0, np.zeros((1, 3)))
    assert grid.at(1.0, 0.0) < 50
    assert max(grid.at(3.99, 0.0), grid.at(4.01, 0.0)) > 50
    assert grid.at(-1.0, 0.0) == -1
    assert grid.at(4.2, 0.0) == -1


def test_beams_that_met_nothing_say_nothing_and_long_ones_free_what_is_near() -> None:
    ranges = np.array([[1.0, 25.0, np.nan, 30.0]], np.float32)
    grid = occupancy(ranges, np.array([0.0, 0.5, 1.0, 1.5]) * np.pi, 30.0, np.array([[0.0, 0.0, 0.0]]))
    assert grid.at(1.01, 0.01) > 50
    # Along y it saw something 25 m off: free as far as beams are followed, but nothing stands there.
    assert [grid.at(0.01, 10.0) < 50, grid.at(0.01, 19.99) > 50] == [True, False]
    assert [grid.at(-0.5, 0.01), grid.at(0.01, -0.5)] == [-1, -1]


@pytest.mark.parametrize("measured", [True, False])
def test_a_drive_around_the_room(measured: bool) -> None:
    turn = np.linspace(0, 2 * np.pi, 160)
    truth = np.column_stack([1.5 * np.cos(turn) - 0.5, 1.2 * np.sin(turn) - 0.5, turn + np.pi / 2])
    ranges = np.stack([room(pose) for pose in truth])
    ranges += np.random.default_rng(1).normal(0, 0.01, ranges.shape).astype(np.float32)
    # The odometry turns too far by a tenth, and is a tenth too long.
    drifting = np.column_stack([1.1 * truth[:, :2], 1.1 * truth[:, 2]])
    found = find_trajectory(np.arange(160) * 0.2, ranges, ANGLES, 30.0, drifting if measured else None)
    error = between(np.repeat(truth[:1], 160, axis=0), truth) - found.poses
    assert np.hypot(error[:, 0], error[:, 1]).max() < 0.05
    assert np.abs(np.degrees((error[:, 2] + np.pi) % (2 * np.pi) - np.pi)).max() < 1


@pytest.mark.parametrize("ranges", [np.full((3, 360), 40.0, np.float32), np.full((3, 360), np.nan, np.float32)])
def test_a_laser_that_sees_nothing_follows_the_odometry(ranges: NDArray[np.float32]) -> None:
    odometry = np.array([[5.0, 5, 0], [6, 5, 0], [7, 5, 0]])
    found = find_trajectory(np.arange(3.0), ranges, ANGLES, 30.0, odometry)
    np.testing.assert_allclose(found.poses, odometry - [5, 5, 0])
