"""Predictions, checkers and the parts that controllers share, by hand."""

import math

import numpy as np
import pytest

from skytether.control.admittance import STANDSTILL, Velocity
from skytether_services.navigation.checkers import GoalChecker, GoalParams, ProgressChecker, ProgressParams
from skytether_services.navigation.controller import FollowedPath, MotionLimits, braking, turn_towards
from skytether_services.navigation.prediction import (
    MAX_COMMANDS,
    Compensation,
    DelayParams,
    PredictedState,
    State,
    replay,
    respond,
)
from skytether_services.planar.geometry import Pose

ORIGIN = Pose(0.0, 0.0, 0.0)
PROMPT = {"linear_acceleration": 1e6, "angular_acceleration": 1e6}
"""A robot that has each velocity at once."""


def test_wheels_follow_with_a_lag_and_a_largest_acceleration() -> None:
    lagging = DelayParams(lag=0.5, **PROMPT)
    # 1 - 1/e of the way after one time constant.
    assert respond(STANDSTILL, Velocity(1.0, 2.0), 0.5, lagging) == pytest.approx((0.632121, 1.264241), abs=1e-6)
    slow = DelayParams(linear_acceleration=0.5, angular_acceleration=1.0)
    assert respond(STANDSTILL, Velocity(1.0, -2.0), 0.1, slow) == pytest.approx((0.05, -0.1))


def test_replay_goes_through_commands_in_turn() -> None:
    state = State(ORIGIN, STANDSTILL, 10.0)
    commands = [(10.0, Velocity(0.5, 0.0)), (10.2, Velocity(0.0, 1.0)), (10.5, Velocity(0.4, 0.0))]
    after = replay(state, commands, 10.6, DelayParams(**PROMPT))
    # 0.2 s at 0.5 m/s, 0.3 s at 1 rad/s, 0.1 s at 0.4 m/s in the new direction; where one velocity goes over into the
    # next, half a step of 10 ms of each is missing or too much.
    assert after.pose.yaw == pytest.approx(0.3, abs=0.006)
    assert after.pose.x == pytest.approx(0.1 + 0.04 * math.cos(0.3), abs=0.006)
    assert after.pose.y == pytest.approx(0.04 * math.sin(0.3), abs=0.006)
    assert after.velocity == pytest.approx((0.4, 0.0))
    assert after.time == pytest.approx(10.6)
    assert replay(state, commands, 9.0, DelayParams()) == state


def test_measured_compensation_replays_what_is_on_its_way() -> None:
    predicted = PredictedState(DelayParams(**PROMPT))
    for n in range(10):
        predicted.sent(Velocity(0.1 * n, 0.0), 1.0 + 0.1 * n, 0.1)
    # The pose is of 1.75 s; commands 6 to 9 arrive at 1.7, 1.8, 1.9, 2.0, and one that is sent at 2.0 arrives at 2.1.
    seen = State(ORIGIN, Velocity(0.6, 0.0), 1.75)
    after = predicted.at_arrival(seen, 2.0, 0.1)
    assert after.time == pytest.approx(2.1)
    assert after.pose.x == pytest.approx(0.05 * 0.6 + 0.1 * (0.7 + 0.8 + 0.9), abs=0.003)
    assert after.velocity.linear == pytest.approx(0.9)
    predicted.clear()
    assert predicted.at_arrival(seen, 2.0, 0.1).pose.x == pytest.approx(0.35 * 0.6)


@pytest.mark.parametrize("compensation", [Compensation.MEASURED, Compensation.FIXED])
def test_a_velocity_that_is_older_than_the_pose_follows_the_commands_since(compensation: Compensation) -> None:
    predicted = PredictedState(DelayParams(compensation=compensation))
    for n in range(4):
        predicted.sent(Velocity(0.4 - 0.03 * n, 0.0), 1.0 + 0.03 * n, 0.0)
    # Commands of 1.00, 1.03, 1.06 and 1.09 s, each 0.03 m/s slower; the pose is of 1.1 s, the velocity of 1.02 s.
    seen = State(ORIGIN, Velocity(0.4, 0.0), 1.1, 0.08)
    after = predicted.at_arrival(seen, 1.1, 0.0)
    assert after.velocity.linear == pytest.approx(0.32, abs=0.011)
    assert after.pose == ORIGIN


def test_an_overtaken_command_never_acts() -> None:
    predicted = PredictedState(DelayParams(**PROMPT))
    predicted.sent(Velocity(0.5, 0.0), 0.0, 0.3)
    predicted.sent(Velocity(0.1, 0.0), 0.1, 0.1)
    after = predicted.at_arrival(State(ORIGIN, STANDSTILL, 0.0), 0.4, 0.1)
    # Standing until 0.2, then at 0.1 m/s until 0.5; the command of 0.5 m/s would arrive at 0.3.
    assert after.pose.x == pytest.approx(0.3 * 0.1, abs=0.002)


def test_fixed_compensation_replays_what_was_sent_within_the_delay() -> None:
    params = DelayParams(compensation=Compensation.FIXED, fixed_delay=0.2, **PROMPT)
    predicted = PredictedState(params)
    predicted.sent(Velocity(0.9, 0.0), 0.7, math.inf)
    predicted.sent(Velocity(0.5, 0.0), 0.9, 0.0)
    after = predicted.at_arrival(State(ORIGIN, Velocity(0.9, 0.0), 0.123), 1.0, 0.05)
    assert after.pose.x == pytest.approx(0.1 * 0.9 + 0.1 * 0.5, abs=0.003)


def test_no_compensation_and_the_limits_of_one() -> None:
    seen = State(ORIGIN, Velocity(0.5, 0.0), 1.0)
    off = PredictedState(DelayParams(compensation=Compensation.OFF))
    off.sent(STANDSTILL, 0.9, 0.1)
    assert off.at_arrival(seen, 2.0, 0.1) == seen
    # A pose of long ago is driven on for max_delay and no longer.
    short = PredictedState(DelayParams(max_delay=0.4))
    assert short.at_arrival(seen, 9.0, math.nan).pose.x == pytest.approx(0.2)
    for _ in range(2 * MAX_COMMANDS):
        short.sent(STANDSTILL, 1.0, 0.1)
    assert short.at_arrival(State(ORIGIN, STANDSTILL, math.nan), 2.0, 0.1).velocity == STANDSTILL


def test_a_goal_is_reached_near_it_turned_and_slow() -> None:
    goal = Pose(1.0, 1.0, 3.1)
    checker = GoalChecker(GoalParams(distance=0.2, heading=0.1, stateful=False))
    assert checker.reached(Pose(1.1, 0.9, -3.1), STANDSTILL, goal)
    assert not checker.reached(Pose(1.3, 1.0, 3.1), STANDSTILL, goal)
    assert not checker.reached(Pose(1.0, 1.0, 2.9), STANDSTILL, goal)
    assert not checker.reached(Pose(1.0, 1.0, 3.1), Velocity(0.3, 0.0), goal)
    assert not checker.reached(Pose(math.nan, 1.0, 3.1), STANDSTILL, goal)


def test_a_stateful_goal_waits_for_the_heading_only() -> None:
    goal = Pose(0.0, 0.0, 0.0)
    checker = GoalChecker(GoalParams(distance=0.2, heading=0.1))
    assert not checker.reached(Pose(0.1, 0.0, 1.0), STANDSTILL, goal)
    assert checker.reached(Pose(0.3, 0.0, 0.0), STANDSTILL, goal)
    checker.reset()
    assert not checker.reached(Pose(0.3, 0.0, 0.0), STANDSTILL, goal)


def test_a_robot_is_stuck_that_neither_moves_nor_turns() -> None:
    checker = ProgressChecker(ProgressParams(distance=0.5, turn=0.5, within=10.0))
    assert not checker.stuck(ORIGIN, 0.0)
    assert not checker.stuck(Pose(0.4, 0.0, 0.0), 9.0)
    assert checker.stuck(Pose(0.4, 0.0, 0.4), 10.1)
    assert not checker.stuck(Pose(0.4, 0.0, 0.6), 10.2)
    assert not checker.stuck(Pose(0.4, 0.0, 0.6), 20.0)
    assert checker.stuck(Pose(math.nan, 0.0, 0.6), 20.3)
    checker.reset()
    assert not checker.stuck(ORIGIN, 99.0)


def test_a_path_knows_how_far_the_robot_has_come() -> None:
    out = [(x, 0.0, 0.0) for x in np.arange(0.0, 3.01, 0.1)]
    back = [(x, 0.2, math.pi) for x in np.arange(3.0, -0.01, -0.1)]
    path = FollowedPath(np.array(out + back))
    assert path.locate(0.5, 0.12) == 5
    ahead = path.ahead(0.5, 0.0, 0.4, 0.05)
    assert ahead[[0, -1], 0].tolist() == pytest.approx([0.5, 0.9])
    assert len(ahead) == 9
    # Lifted and put down at the far end.
    assert path.locate(3.0, 0.0) == 30
    assert path.left() == pytest.approx(3.2)
    assert path.goal == pytest.approx((0.0, 0.2, math.pi))
    with pytest.raises(ValueError, match="n by 3"):
        FollowedPath(np.array([[0.0, math.nan, 0.0]]))


def test_a_turn_on_the_spot_ends_without_overshoot() -> None:
    limits = MotionLimits(max_angular=1.0, angular_acceleration=2.0)
    yaw, rate, most = 0.0, 0.0, 0.0
    for _ in range(200):
        rate = turn_towards(2.0 - yaw, rate, limits, 0.033)
        yaw += rate * 0.033
        most = max(most, yaw)
    assert yaw == pytest.approx(2.0, abs=0.01)
    assert most < 2.02
    assert turn_towards(-1.0, 0.0, limits, 0.1) == pytest.approx(-0.2)


def test_braking_ends_at_standstill() -> None:
    limits = MotionLimits(linear_acceleration=1.0, angular_acceleration=2.0)
    assert braking(Velocity(0.5, -0.1), limits, 0.1) == pytest.approx((0.4, 0.0))
    assert braking(Velocity(-0.05, 0.5), limits, 0.1) == pytest.approx((0.0, 0.3))
