"""Paths on small grids, with lengths that can be told by hand. Numba compiles for seconds in a fresh clone."""

import math

import numpy as np
import pytest

from skytether_services.navigation.costmap import INSCRIBED, LETHAL, UNKNOWN, Costmap, InflationParams
from skytether_services.navigation.footprint import Footprint, FootprintChecks, misfits
from skytether_services.navigation.layers import LayeredCostmap
from skytether_services.navigation.planner import PlannerParams, PlanStatus, plan, resample, with_headings
from skytether_services.planar.geometry import Pose


def empty(rows: int = 60, columns: int = 100) -> np.ndarray:
    return np.zeros((rows, columns), dtype=np.uint8)


def inflated(costs: np.ndarray) -> Costmap:
    footprint = Footprint(radius=0.25, padding=0.0)
    return LayeredCostmap(Costmap(costs, 0.1), footprint, inflation=InflationParams(radius=0.6)).compose()


START, GOAL = Pose(1.0, 3.0, 0.0), Pose(9.0, 3.0, 1.0)


def test_resampled_lines_are_even_and_keep_their_ends() -> None:
    line = resample(np.array([[0.0, 0.0], [0.3, 0.0], [0.3, 0.6]]), 0.2)
    assert line[0].tolist() == [0.0, 0.0]
    assert line[-1].tolist() == [0.3, 0.6]
    # 0.9 along, in pieces of at most 0.2: five of 0.18.
    assert line[1].tolist() == pytest.approx([0.18, 0.0])
    assert line[2].tolist() == pytest.approx([0.3, 0.06])


def test_headings_lead_to_the_next_point() -> None:
    points = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    assert with_headings(points, -1.0)[:, 2].tolist() == pytest.approx([0.0, math.pi / 2, -1.0])


@pytest.mark.parametrize(
    ("start", "goal", "status"),
    [
        (Pose(-1.0, 0.0, 0.0), GOAL, PlanStatus.START_OFF_MAP),
        (START, Pose(50.0, 3.0, 0.0), PlanStatus.GOAL_OFF_MAP),
        (START, Pose(math.nan, 3.0, 0.0), PlanStatus.NOT_FINITE),
        (START, Pose(1.0, math.inf, 0.0), PlanStatus.NOT_FINITE),
    ],
)
def test_what_is_off_the_map_is_told(start: Pose, goal: Pose, status: PlanStatus) -> None:
    result = plan(Costmap(empty(), 0.1), start, goal, PlannerParams())
    assert result.status is status
    assert result.message
    assert len(result.path) == 0


@pytest.mark.slow
def test_in_free_space_the_path_is_straight() -> None:
    result = plan(Costmap(empty(), 0.1), Pose(1.0, 1.0, 0.0), Pose(9.0, 4.0, 1.0), PlannerParams())
    assert result.status is PlanStatus.FOUND
    assert result.message == ""
    assert result.length == pytest.approx(math.hypot(8, 3), rel=0.003)
    assert result.path[0, :2].tolist() == [1.0, 1.0]
    assert result.path[-1].tolist() == pytest.approx([9.0, 4.0, 1.0])
    assert np.hypot(*np.diff(result.path[:, :2], axis=0).T).max() <= 0.12


@pytest.mark.slow
def test_it_goes_around_a_wall_through_the_gap() -> None:
    costs = empty()
    costs[:40, 50] = LETHAL
    costmap = inflated(costs)
    result = plan(costmap, START, GOAL, PlannerParams())
    assert result.status is PlanStatus.FOUND
    assert max(costmap.at(x, y) for x, y, _ in result.path) < INSCRIBED
    # Around the wall's end with the robot's radius; not much longer.
    shortest = 2 * math.hypot(4, 4.0 + 0.25 - 3.0)
    assert shortest < result.length < shortest + 0.6
    assert np.abs(np.diff(np.unwrap(result.path[:-1, 2]))).max() < 0.3


@pytest.mark.slow
def test_a_goal_in_an_obstacle_moves_within_the_tolerance() -> None:
    costs = empty()
    costs[28:33, 88:93] = LETHAL
    costmap = inflated(costs)
    result = plan(costmap, START, GOAL, PlannerParams(tolerance=0.8))
    assert result.status is PlanStatus.FOUND
    assert "is in an obstacle" in result.message
    assert result.goal is not None
    assert math.dist(result.goal[:2], GOAL[:2]) <= 0.8
    assert result.goal.yaw == GOAL.yaw
    assert costmap.at(*result.goal[:2]) < INSCRIBED
    refused = plan(costmap, START, GOAL, PlannerParams(tolerance=0.2))
    assert refused.status is PlanStatus.GOAL_BLOCKED
    assert "(9.00, 3.00) is in an obstacle" in refused.message


@pytest.mark.slow
def test_behind_a_closed_wall_there_is_no_path() -> None:
    costs = empty()
    costs[:, 50] = LETHAL
    result = plan(inflated(costs), START, GOAL, PlannerParams())
    assert result.status is PlanStatus.NO_PATH
    assert result.goal is None
    # Behind it, but within the tolerance of this side.
    near = plan(inflated(costs), START, Pose(5.35, 3.0, 0.0), PlannerParams(tolerance=1.0))
    assert near.status is PlanStatus.FOUND
    assert near.goal is not None
    assert near.goal.x < 5.0
    assert "cannot be reached" in near.message


@pytest.mark.slow
def test_a_start_in_an_obstacle_leaves_it() -> None:
    costs = empty()
    costs[:, 8] = LETHAL
    costmap = inflated(costs)
    assert plan(costmap, START, GOAL, PlannerParams(start_tolerance=0.3)).status is PlanStatus.FOUND
    assert plan(costmap, START, GOAL, PlannerParams(start_tolerance=0.05)).status is PlanStatus.START_BLOCKED


@pytest.mark.slow
def test_the_unknown_is_used_only_where_allowed() -> None:
    costs = empty()
    costs[:, 40:60] = UNKNOWN
    costmap = inflated(costs)
    assert plan(costmap, START, GOAL, PlannerParams()).status is PlanStatus.FOUND
    assert plan(costmap, START, GOAL, PlannerParams(allow_unknown=False)).status is PlanStatus.NO_PATH


@pytest.mark.slow
def test_at_the_goal_the_path_is_two_poses() -> None:
    result = plan(Costmap(empty(), 0.1), START, Pose(1.01, 3.01, 2.0), PlannerParams())
    assert result.status is PlanStatus.FOUND
    assert len(result.path) == 2
    assert result.path[-1].tolist() == pytest.approx([1.01, 3.01, 2.0])


LONG = Footprint(corners=((0.35, 0.25), (-0.35, 0.25), (-0.35, -0.25), (0.35, -0.25)), padding=0.0)
"""0.7 m by 0.5 m: its corners are 0.43 m from its middle."""


def with_gaps(*gaps: tuple[float, float]) -> Costmap:
    """A wall along x = 5 m, 0.4 m thick, with gaps, each from y to y [m]."""
    costs = np.zeros((120, 200), dtype=np.uint8)
    costs[:, 96:104] = LETHAL
    for low, high in gaps:
        costs[round(low * 20) : round(high * 20), 96:104] = 0
    return LayeredCostmap(Costmap(costs, 0.05), LONG, inflation=InflationParams(radius=0.6)).compose()


def crossing(costmap: Costmap, start: Pose, goal: Pose, margin: float = 0.05, **params: float) -> float:
    """Where a path crosses the wall: y [m]."""
    checks = FootprintChecks(LONG, InflationParams(radius=0.6), margin)
    result = plan(costmap, start, goal, PlannerParams(margin=margin, **params), checks)
    assert result.status is PlanStatus.FOUND
    assert result.path[-1, :2].tolist() == pytest.approx(goal[:2])
    return float(np.interp(5.0, result.path[:, 0], result.path[:, 1]))


@pytest.mark.slow
def test_a_gap_that_leaves_no_room_beside_the_robot_is_left_for_a_wider_one_near_by() -> None:
    gaps = ((1.0, 1.55), (4.6, 5.7))
    start, goal = Pose(3.0, 1.25, 0.0), Pose(7.0, 1.25, 0.0)
    assert crossing(with_gaps(*gaps), start, goal, detour=0.0) == pytest.approx(1.28, abs=0.05)
    assert 4.7 < crossing(with_gaps(*gaps), start, goal) < 5.6
    # Not for one that is farther off than the detour may be, and not where there is no other.
    assert crossing(with_gaps(*gaps), start, goal, detour=0.3) == pytest.approx(1.28, abs=0.05)
    assert crossing(with_gaps(gaps[0]), start, goal) == pytest.approx(1.28, abs=0.05)


@pytest.mark.slow
def test_a_robot_in_a_narrow_place_goes_on_through_it() -> None:
    gaps = ((1.0, 1.55), (4.6, 5.7))
    assert crossing(with_gaps(*gaps), Pose(4.95, 1.28, 0.0), Pose(7.0, 1.25, 0.0)) == pytest.approx(1.28, abs=0.05)


@pytest.mark.slow
def test_a_path_bends_only_where_the_robot_has_room_to_turn() -> None:
    costmap = with_gaps((1.0, 1.65))
    checks = FootprintChecks(LONG, InflationParams(radius=0.6), 0.0)
    frame, samples, check_from = checks.on(costmap)
    straight = np.array([(x, 1.325, 0.0) for x in np.arange(4.0, 6.0, 0.05)])
    assert not misfits(straight, costmap.costs, frame, samples, check_from).any()
    # The same places, but in the gap it faces 0.6 rad to the side for one of them.
    straight[20, 2] = 0.6
    assert np.flatnonzero(misfits(straight, costmap.costs, frame, samples, check_from)).tolist() == [20, 21]
