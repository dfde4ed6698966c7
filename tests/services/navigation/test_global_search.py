"""The search of a whole map, in the room of `test_scan_matching`. Its functions compile for a while."""

from __future__ import annotations

import math

import numpy as np
import pytest

from skytether_services.navigation.global_search import judge, search
from skytether_services.navigation.grid_map import GridMap
from skytether_services.navigation.likelihood_field import likelihood_field, score_beams, score_poses
from skytether_services.navigation.localisation import Localisation
from skytether_services.navigation.log_odds import occupancy
from skytether_services.navigation.poses import between, compose
from skytether_services.navigation.scan_matching import scan_points
from skytether_services.navigation.seen_floor import Floor

from .test_scan_matching import ANGLES, room

pytestmark = pytest.mark.slow


def room_map() -> GridMap:
    seen = np.array([[0.0, 0.0, turn] for turn in (0.0, math.pi / 2, math.pi, -math.pi / 2)])
    return occupancy(np.array([room(pose) for pose in seen]), ANGLES, 30.0, seen)


def test_the_place_of_a_scan_is_found_in_the_whole_map() -> None:
    # From here it sees the box, without which the room looks the same from its other end.
    truth = np.array([-1.3, 0.4, 0.2])
    ends = scan_points(room(truth), ANGLES, 30.0)[:, :2]
    found = search(likelihood_field(room_map()), np.zeros(ends.shape), ends, np.random.default_rng(1))
    # Half a step of the grid and of the headings is what the search itself is wrong by; then it is made fine.
    np.testing.assert_allclose(found[0].pose, truth, atol=0.05)
    assert found[0].explained.share > 0.9


def test_a_beam_through_a_wall_is_an_outlier_and_one_to_where_the_map_knows_nothing_says_little() -> None:
    cells = np.zeros((20, 90), np.int8)
    cells[:, 20] = cells[:, 40] = 100  # walls at 2 m and 4 m
    cells[:, 50:] = -1
    field = likelihood_field(GridMap(cells, 0.1, (0.0, 0.0, 0.0)))
    starts, ends = np.zeros((3, 2)), np.array([[3.0, 0.0], [3.0, 0.01], [3.0, -0.01]])
    poses = np.array([[1.05, 1.05, 0.0], [4.35, 1.05, 0.0], [1.05, 1.05, math.pi]])
    through, unknown, off_the_map = score_beams(field, poses, starts, ends, 0.25) / 3
    assert score_poses(field, poses[:1], ends)[0] == pytest.approx(0.0, abs=0.1)  # its ends alone fit
    assert through == pytest.approx(math.log(field.model.outlier))
    assert unknown == pytest.approx(math.log(field.model.unknown))
    assert off_the_map == pytest.approx(math.log(field.model.unknown))


def test_a_beam_that_ends_in_the_open_speaks_against_a_place_more_than_one_through_what_the_map_shows() -> None:
    cells = np.zeros((20, 90), np.int8)
    cells[:, 40] = 100  # a wall at 4 m
    cells[:, 60:] = -1
    field = likelihood_field(GridMap(cells, 0.1, (0.0, 0.0, 0.0)))
    starts, ends = np.zeros((3, 2)), np.array([[3.0, 0.0], [3.0, 0.01], [3.0, -0.01]])
    poses = np.array([[x, 1.05, 0.0] for x in (1.05, 4.55, 2.45, 0.45)])
    floor = Floor(np.zeros((0, 2)), np.zeros((0, 2)))
    explained, unknown, through, in_the_open = (judge(field, pose, starts, ends, floor).score for pose in poses)
    assert explained == pytest.approx(0.0)
    assert in_the_open < through < unknown < explained


def test_a_pose_that_the_map_contradicts_gives_way_to_one_that_it_explains() -> None:
    localisation = Localisation(likelihood_field(room_map()), np.random.default_rng(1))
    truth = np.array([-1.3, 0.4, 0.2])
    # Through the walls, from the begin: nothing breaks.
    localisation.place(np.array([1.0, 0.4, 1.5]), np.diag([0.0001, 0.0001, 0.0001]))
    step = np.array([0.1, 0.0, 0.03])
    estimates = []
    for _ in range(30):
        truth = compose(truth, step)
        estimates.append(localisation.update(step, scan_points(room(truth), ANGLES, 30.0)[:, :2]))
    assert not any(estimate.sure for estimate in estimates[8:12])
    assert estimates[-1].sure
    np.testing.assert_allclose(between(truth, estimates[-1].pose), 0.0, atol=0.1)
