"""Rays and footprints on small grids; numba compiles them, which takes seconds in a fresh clone."""

import math

import numpy as np
import pytest

from skytether_services.navigation.costmap import FREE, INSCRIBED, LETHAL, UNKNOWN, Costmap, InflationParams
from skytether_services.navigation.footprint import Footprint, cost_at
from skytether_services.navigation.layers import LayeredCostmap
from skytether_services.navigation.obstacles import ObstacleParams, Scan, mark_and_clear
from skytether_services.planar.geometry import Pose

pytestmark = pytest.mark.slow


AT_THE_LEFT = Pose(0.05, 0.25, 0.0)


def scan_of(ranges: list[float], sensor: Pose = AT_THE_LEFT, *, angle: float = 0.0) -> Scan:
    return Scan(np.array(ranges, dtype=np.float32), angle, 0.0, sensor, range_max=10.0)


def test_a_ray_clears_its_way_and_marks_its_end() -> None:
    marks = np.full((5, 10), UNKNOWN, dtype=np.uint8)
    assert mark_and_clear(marks, 0.1, (0.0, 0.0), scan_of([0.5]), ObstacleParams()) == 1
    assert marks[2].tolist() == [FREE] * 5 + [LETHAL] + [UNKNOWN] * 4
    assert (marks[[0, 1, 3, 4]] == UNKNOWN).all()
    # The obstacle goes, a wall behind it is seen: cleared.
    mark_and_clear(marks, 0.1, (0.0, 0.0), scan_of([0.8]), ObstacleParams())
    assert marks[2].tolist() == [FREE] * 8 + [LETHAL] + [UNKNOWN]


def test_rays_that_met_nothing_clear_and_bad_ones_do_nothing() -> None:
    marks = np.full((5, 10), LETHAL, dtype=np.uint8)
    params = ObstacleParams(mark_range=0.3, clear_range=0.4)
    assert mark_and_clear(marks, 0.1, (0.0, 0.0), scan_of([math.inf]), params) == 0
    assert marks[2].tolist() == [FREE] * 5 + [LETHAL] * 5
    before = marks.copy()
    for bad in (math.nan, -1.0, 0.0, -math.inf):
        assert mark_and_clear(marks, 0.1, (0.0, 0.0), scan_of([bad], Pose(0.05, 0.05, 0.0)), params) == 0
    for sensor in (Pose(math.nan, 0.0, 0.0), Pose(50.0, 0.0, 0.0), Pose(0.0, 0.0, math.inf)):
        assert mark_and_clear(marks, 0.1, (0.0, 0.0), scan_of([0.2], sensor), params) == 0
    assert (marks == before).all()
    # Beyond the range of marking: cleared up to there, not marked.
    marks.fill(UNKNOWN)
    assert mark_and_clear(marks, 0.1, (0.0, 0.0), scan_of([0.35]), params) == 0
    assert LETHAL not in marks


def test_no_ray_removes_what_another_one_saw() -> None:
    marks = np.full((5, 10), UNKNOWN, dtype=np.uint8)
    mark_and_clear(marks, 0.1, (0.0, 0.0), scan_of([0.5, 0.8]), ObstacleParams())
    assert marks[2, 5] == LETHAL
    assert marks[2, 8] == LETHAL


def test_a_diagonal_ray_stays_on_the_diagonal() -> None:
    marks = np.full((6, 6), UNKNOWN, dtype=np.uint8)
    scan = scan_of([0.4 * math.sqrt(2)], Pose(0.05, 0.05, math.pi / 4))
    mark_and_clear(marks, 0.1, (0.0, 0.0), scan, ObstacleParams())
    assert [marks[i, i] for i in range(6)] == [FREE, FREE, FREE, FREE, LETHAL, UNKNOWN]
    assert (marks != UNKNOWN).sum() == 5


def test_a_box_turned_hits_what_it_passes_straight() -> None:
    costs = np.zeros((40, 40), dtype=np.uint8)
    costs[:, 26] = LETHAL
    box = Footprint(corners=((0.5, 0.2), (-0.5, 0.2), (-0.5, -0.2), (0.5, -0.2)), padding=0.0)
    costmap = LayeredCostmap(Costmap(costs, 0.1), box, inflation=InflationParams(radius=0.6)).compose()
    # The wall is at 2.6 m: from 2.25 m on, half the width of 0.2 m fits beside it, half the length of 0.5 m does not.
    beside = cost_at(costmap, box, Pose(2.25, 2.0, math.pi / 2))
    assert 0 < beside < INSCRIBED
    assert cost_at(costmap, box, Pose(2.25, 2.0, 0.0)) == LETHAL
    assert cost_at(costmap, box, Pose(2.45, 2.0, math.pi / 2)) == LETHAL
    assert cost_at(costmap, box, Pose(-5.0, 0.0, 0.0)) == FREE


def test_a_small_thing_within_the_outline_is_found() -> None:
    costs = np.zeros((60, 60), dtype=np.uint8)
    costs[30, 38] = LETHAL
    box = Footprint(corners=((0.5, 0.2), (-0.5, 0.2), (-0.5, -0.2), (0.5, -0.2)), padding=0.0)
    costmap = LayeredCostmap(Costmap(costs, 0.05), box, inflation=InflationParams(radius=0.6)).compose()
    assert cost_at(costmap, box, Pose(1.525, 1.525, 0.0)) == LETHAL
