"""MPPI and DWA: each part by hand, then both in closed loops. Numba compiles for seconds in a fresh clone."""

import math

import numpy as np
import pytest
from grid_world import INFLATION, LIMITS, drive

from skytether.control.admittance import STANDSTILL, Velocity
from skytether_services.navigation.controller import Controller, ControlStatus
from skytether_services.navigation.costmap import LETHAL, Costmap
from skytether_services.navigation.dwa import Dwa, best_velocity, spread
from skytether_services.navigation.footprint import Footprint
from skytether_services.navigation.layers import LayeredCostmap
from skytether_services.navigation.mppi import Mppi, MppiParams
from skytether_services.navigation.mppi_kernels import (
    COLLISION,
    correlate,
    furthest,
    motion_costs,
    obstacle_costs,
    path_costs,
    rollout,
    weighted_mean,
)
from skytether_services.navigation.prediction import DelayParams
from skytether_services.planar.geometry import Pose, advance

pytestmark = pytest.mark.slow

WIDE = np.array([-1.0, 1.0, 2.0, 1e6, 1e6])
"""Limits that nothing meets."""
ROUND = Footprint(radius=0.3)
BOX = Footprint(corners=((0.35, 0.25), (-0.35, 0.25), (-0.35, -0.25), (0.35, -0.25)))
NO_SAMPLES = np.empty((0, 2))


def rolled(
    planned: list[float], limits: np.ndarray = WIDE, *, steps: int = 20, velocity: Velocity = STANDSTILL
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One trajectory of 0.1 s steps from (0, 0), heading along x."""
    plan = np.repeat(np.array(planned)[:, None], steps, axis=1)
    controls, poses = np.empty((2, 1, steps), np.float32), np.empty((1, steps, 4), np.float32)
    start = np.array([0.0, 0.0, 0.0, *velocity])
    rollout(plan, np.zeros((2, 1, steps), np.float32), start, 0.1, limits, controls, poses)
    return plan, controls, poses


def controller_of(name: str, footprint: Footprint) -> Controller:
    if name == "dwa":
        return Dwa(footprint, LIMITS, INFLATION)
    return Mppi(footprint, LIMITS, INFLATION, np.random.default_rng(1))


def room(wall_at: float | None = None) -> Costmap:
    costs = np.zeros((120, 120), dtype=np.uint8)
    if wall_at is not None:
        costs[:, round(wall_at / 0.05) :] = LETHAL
    return LayeredCostmap(Costmap(costs, 0.05), ROUND, inflation=INFLATION).compose()


STRAIGHT = np.array([(x, 3.0, 0.0) for x in np.arange(1.0, 5.01, 0.05)])


def test_a_rollout_drives_an_arc() -> None:
    _, _, poses = rolled([0.5, 0.8])
    end = advance(Pose(0.0, 0.0, 0.0), 0.5, 0.8, 2.0)
    assert poses[0, -1, :2] == pytest.approx(end[:2], abs=5e-4)
    assert math.atan2(poses[0, -1, 3], poses[0, -1, 2]) == pytest.approx(end.yaw, abs=1e-5)


def test_a_rollout_keeps_the_limits() -> None:
    _, controls, _ = rolled([9.0, -9.0], np.array([-0.1, 0.5, 1.0, 1.0, 2.0]))
    assert controls[0, 0, :6] == pytest.approx([0.1, 0.2, 0.3, 0.4, 0.5, 0.5])
    assert controls[1, 0, :6] == pytest.approx([-0.2, -0.4, -0.6, -0.8, -1.0, -1.0])


def test_lasting_noise_keeps_its_variance() -> None:
    noise = np.random.default_rng(0).standard_normal((4000, 10), dtype=np.float32)
    correlate(noise, 0.8)
    assert noise[:, 9].std() == pytest.approx(1.0, abs=0.05)
    assert np.corrcoef(noise[:, 5], noise[:, 6])[0, 1] == pytest.approx(0.8, abs=0.03)


def test_cells_on_the_way_cost_and_a_collision_costs_all() -> None:
    _, _, poses = rolled([1.0, 0.0])
    costs = np.full((10, 40), 127, dtype=np.uint8)
    frame, total = np.array([0.1, 0.0, -0.5]), np.zeros(1)
    assert obstacle_costs(poses, 0.0, 0.0, costs, frame, NO_SAMPLES, 255, 2, 4.0, False, total) == 1
    assert total[0] == pytest.approx(4.0 * 127 / 254)
    assert obstacle_costs(poses, 0.0, 0.0, costs, frame, NO_SAMPLES, 255, 2, 4.0, True, total) == 1
    assert total[0] == pytest.approx(2.0)
    costs[:, 15] = 253
    assert obstacle_costs(poses, 0.05, 0.0, costs, frame, NO_SAMPLES, 255, 1, 4.0, False, total) == 0
    assert total[0] > COLLISION


def test_path_critics() -> None:
    _, controls, poses = rolled([0.5, 0.0])
    # From (0.05, 0) to (1, 0), along a path 0.1 m to the left; the pose to follow is at (1, 0.1).
    path = np.array([(x, 0.1, 0.0) for x in np.arange(0.0, 1.51, 0.05)])
    assert furthest(poses, path) == 20
    every = np.ones(len(path), dtype=np.bool_)
    for weights, expected in (
        ([2.0, 0.0, 0.0], 2.0 * 0.1),
        ([0.0, 3.0, 0.0], 3.0 * 0.1),
    ):
        total = np.zeros(1)
        path_costs(controls, poses, path, every, 20, 0.1, 0.05, 1, np.array(weights), total)
        assert total[0] == pytest.approx(expected, abs=1e-3)
    total = np.zeros(1)
    path_costs(controls, poses, path, ~every, 20, 0.1, 0.05, 1, np.array([0.0, 3.0, 0.0]), total)
    assert total[0] == 0.0
    # A pose to follow that is right behind: half a turn off, all the way.
    path[0] = (-5.0, 0.0, 0.0)
    path_costs(controls, poses, path, every, 0, 0.1, 0.05, 1, np.array([0.0, 0.0, 2.0]), total)
    assert total[0] == pytest.approx(2.0 * math.pi, rel=1e-3)


def test_motion_critics() -> None:
    plan, controls, poses = rolled([-0.5, 0.0])
    goal, wheels, none = np.array([1.0, 0.0, 0.5]), np.array([0.2, 0.4]), np.zeros(2)
    for weights, expected in (
        # On average 0.525 m back from the start, which is 1 m from the goal.
        ([1.0, 0.0, 0.0, 0.0], 1.525),
        ([0.0, 2.0, 0.0, 0.0], 2.0 * 0.5),
        # 1 m backwards; its wheels are 0.1 m/s too fast for 2 s.
        ([0.0, 0.0, 5.0, 0.0], 5.0),
        ([0.0, 0.0, 0.0, 4.0], 4.0 * 0.2),
    ):
        total = np.zeros(1)
        motion_costs(plan, controls, poses, goal, 0.1, wheels, np.array(weights), none, total)
        assert total[0] == pytest.approx(expected, rel=1e-4)
    total = np.zeros(1)
    motion_costs(plan + 0.1, controls, poses, goal, 0.1, wheels, np.zeros(4), np.array([2.0, 0.0]), total)
    # 2 * -0.4 * (-0.5 + 0.4), in 20 steps.
    assert total[0] == pytest.approx(1.6, rel=1e-4)


def test_the_mean_goes_by_exponential_weights() -> None:
    controls = np.zeros((2, 2, 3), dtype=np.float32)
    controls[0, 0] = 1.0
    mean = np.empty((2, 3))
    # exp(-ln 3) = 1/3 of the other one's weight: 3/4 and 1/4.
    weighted_mean(controls, np.array([5.0, 5.0 + 0.3 * math.log(3)]), 0.3, mean)
    assert mean[0] == pytest.approx([0.75] * 3)


def test_distances_spread_around_walls() -> None:
    costs = np.zeros((3, 4), dtype=np.uint8)
    costs[:2, 1] = LETHAL
    distances = spread(costs, np.array([0], dtype=np.int32))
    assert distances.tolist() == [[0, math.inf, 6, 7], [1, math.inf, 5, 6], [2, 3, 4, 5]]


def test_the_best_velocity_leads_to_the_goal() -> None:
    costs = np.zeros((60, 60), dtype=np.uint8)
    distances = spread(costs, np.array([30 * 60 + 50], dtype=np.int32))
    arguments = (
        np.array([1.0, 3.05, 0.0]), np.array([0.0, 0.25, 0.5]), np.array([-1.0, 0.0, 1.0]), 0.0,
        np.array([1.0, 0.1]), costs, np.array([0.1, 0.0, 0.0]), NO_SAMPLES, 255,
        distances, distances, np.array([1.0, 1.0, 0.3, 0.01, 0.1]), np.array([5.05, 3.05]),
    )  # fmt: skip
    v, w, best = best_velocity(*arguments, False)
    # 0.5 m nearer than 4 m: in cells, for the centre and the point in front, each with both weights.
    assert (v, w) == (0.5, 0.0)
    assert best == pytest.approx(2 * 35 + 2 * 32)
    # Near the goal by the straight distance, which is 3.55 m.
    assert best_velocity(*arguments, True) == pytest.approx((0.5, 0.0, 2 * 35.5))
    costs[:] = 253
    assert best_velocity(*arguments, False)[2] == math.inf


def test_dwa_is_quick_over_the_last_metre() -> None:
    controller, pose, velocity = Dwa(ROUND, LIMITS, INFLATION), Pose(4.0, 3.03, 0.1), Velocity(0.5, 0.0)
    controller.set_path(STRAIGHT)
    steps, costmap = 0, room()
    while math.dist(pose[:2], STRAIGHT[-1, :2]) > 0.12 and steps < 300:
        velocity = controller.control(pose, velocity, costmap).velocity
        pose = advance(pose, *velocity, 1 / 30)
        steps += 1
    # 0.88 m at 0.5 m/s are 53 steps; braking from 0.36 m on costs a few.
    assert steps < 65


@pytest.mark.parametrize("name", ["mppi", "dwa"])
def test_statuses_of_a_controller(name: str) -> None:
    controller = controller_of(name, ROUND)
    here = Pose(1.0, 3.0, 0.0)
    assert controller.control(here, STANDSTILL, room()).status is ControlStatus.NO_PATH
    controller.set_path(STRAIGHT)
    assert controller.control(Pose(math.nan, 3.0, 0.0), STANDSTILL, room()).status is ControlStatus.NOT_FINITE
    assert controller.control(here, Velocity(math.inf, 0.0), room()).status is ControlStatus.NOT_FINITE
    driving = controller.control(here, Velocity(0.3, 0.0), room())
    assert driving.status is ControlStatus.DRIVING
    assert driving.velocity.linear > 0.25
    assert driving.trajectory.shape[1] == 3
    blocked = controller.control(here, STANDSTILL, room(wall_at=1.2))
    assert blocked.status is ControlStatus.BLOCKED
    assert blocked.velocity == STANDSTILL
    controller.set_path(np.empty((0, 3)))
    assert controller.control(here, STANDSTILL, room()).status is ControlStatus.NO_PATH


@pytest.mark.parametrize("name", ["mppi", "dwa"])
def test_a_speed_zone_is_kept(name: str) -> None:
    controller = controller_of(name, ROUND)
    controller.set_path(STRAIGHT)
    pose, velocity = Pose(1.0, 3.0, 0.0), STANDSTILL
    for _ in range(60):
        velocity = controller.control(pose, velocity, room(), speed_limit=0.2).velocity
        pose = advance(pose, *velocity, 1 / 30)
        assert velocity.linear <= 0.2 + 1e-6
    assert velocity.linear > 0.15


@pytest.mark.parametrize("round_trip", [0.0, 0.2])
@pytest.mark.parametrize("heading", [math.pi, 0.97 * math.pi])
def test_dwa_gets_away_from_a_wall_that_leaves_no_room_for_half_a_turn(heading: float, round_trip: float) -> None:
    # The wall is 0.37 m from the robot's middle: its corners, 0.43 m away, do not get past it.
    result = drive(
        controller_of("dwa", BOX),
        BOX,
        start=Pose(3.0, 0.87, heading),
        goal=Pose(4.0, 1.8, 0.0),
        round_trip=round_trip,
        delay=DelayParams(
            linear_acceleration=LIMITS.linear_acceleration, angular_acceleration=LIMITS.angular_acceleration
        ),
    )
    assert result.reached
    assert result.touched == 0
    assert result.seconds < 20
    assert min(pose.x for pose in result.way) > 2.0, "it does not drive far off to turn"


def test_dwa_that_stands_askew_turns_along_its_path_and_drives() -> None:
    # Where a half turn had left it: the path leads off by 0.9 rad, less than what is turned on the spot at speed.
    result = drive(
        controller_of("dwa", BOX),
        BOX,
        start=Pose(2.744, 1.01, -0.339),
        goal=Pose(4.0, 1.8, 0.0),
        round_trip=0.0,
        delay=DelayParams(),
        limit=15.0,
    )
    assert result.reached


def test_mppi_repeats_itself_with_the_same_seed() -> None:
    results = []
    for _ in range(2):
        controller = Mppi(ROUND, LIMITS, INFLATION, np.random.default_rng(7), MppiParams(trajectories=100))
        controller.set_path(STRAIGHT)
        results.append([controller.control(Pose(1.0, 3.1, 0.2), STANDSTILL, room()).velocity for _ in range(3)])
    assert results[0] == results[1]


@pytest.mark.parametrize("round_trip", [0.0, 0.2])
@pytest.mark.parametrize("name", ["mppi", "dwa"])
def test_it_reaches_the_goal_around_a_box_and_touches_nothing(name: str, round_trip: float) -> None:
    result = drive(
        controller_of(name, BOX),
        BOX,
        start=Pose(0.8, 1.0, 0.0),
        goal=Pose(10.2, 4.2, math.pi / 2),
        round_trip=round_trip,
        delay=DelayParams(
            linear_acceleration=LIMITS.linear_acceleration, angular_acceleration=LIMITS.angular_acceleration
        ),
    )
    assert result.reached
    assert result.touched == 0
    # 10.8 m at 0.5 m/s are 21.6 s.
    assert result.seconds < 30
