"""Follower, filter and odometry of the virtual trail."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skytether_services.virtual_trail.filter import LowPass
from skytether_services.virtual_trail.follower import lateral_error, orientation_error, preview_distance
from skytether_services.virtual_trail.odometry import Odometry, Wheels, roll
from skytether_services.virtual_trail.path import Path, Pose

STRAIGHT = Path([(10.0, 0.0)])
LEFT = Path([(1.0, 0.0), (math.pi, 0.5)])


def test_left_of_the_trail_is_positive() -> None:
    assert lateral_error(STRAIGHT, Pose(3, 0.2, 0), 3) == pytest.approx(0.2)
    # quarter of the arc about (1, 2): the trail is at (3, 2), heading +y, so x = 3.1 is to its right
    assert lateral_error(LEFT, Pose(3.1, 2, 0), 1 + math.pi) == pytest.approx(-0.1)


def test_turns_back_to_the_trail_by_the_arc_tangent_of_the_lateral_error() -> None:
    # 0.5 m to the left, gain 2/m: desired heading -atan(1) = -pi/4; the walker heads 0.1
    error = orientation_error(STRAIGHT, Pose(3, 0.5, 0.1), 3, lateral_gain=2, preview=0.3)
    assert error == pytest.approx(-math.pi / 4 - 0.1)


def test_never_asks_for_more_than_a_right_angle_to_the_trail() -> None:
    error = orientation_error(STRAIGHT, Pose(3, -1e9, 0), 3, lateral_gain=2, preview=0.3)
    assert error == pytest.approx(math.pi / 2)


def test_sees_the_arc_ahead() -> None:
    # 0.2 m before the arc of curvature 0.5/m with 0.6 m of preview: the tangent has turned by 0.4 * 0.5
    error = orientation_error(LEFT, Pose(0.8, 0, 0), 0.8, lateral_gain=2, preview=0.6)
    assert error == pytest.approx(0.2)


def test_error_takes_the_short_way_round() -> None:
    error = orientation_error(STRAIGHT, Pose(3, 0, math.radians(350)), 3, lateral_gain=2, preview=0.3)
    assert error == pytest.approx(math.radians(10))


def test_preview_makes_a_steady_turn_of_the_arc_s_curvature() -> None:
    # steady, eq. 2.4 in 2.3: omega = k_tau v d error / d_omega; on curvature c the error is c preview, so omega = c v
    preview = preview_distance(torque_gain=50, sensor_distance=0.5, angular_damping=6)
    assert preview == pytest.approx(0.24)
    curvature, v = 0.8, 0.2
    assert 50 * v * 0.5 * (curvature * preview) / 6 == pytest.approx(curvature * v)


def test_filter_reaches_63_per_cent_after_its_time_constant_whatever_the_rate() -> None:
    for steps in (10, 1000):
        low = LowPass(cutoff=2.0)  # time constant 1 / (2 pi 2) s
        low.step(0.0, 0.0)
        for _ in range(steps):
            low.step(10.0, 1 / (4 * math.pi) / steps)
        assert low.value == pytest.approx(10 * (1 - math.exp(-1)))


def test_filter_halves_the_power_at_the_cutoff() -> None:
    low, dt = LowPass(cutoff=2.0), 0.0005
    low.step(0.0, dt)
    out = [low.step(math.sin(math.tau * 2.0 * i * dt), dt) for i in range(8000)]
    assert max(out[4000:]) == pytest.approx(math.sqrt(0.5), rel=0.01)


def test_filter_starts_at_its_first_value() -> None:
    low = LowPass(2.0)
    assert low.step(7.0, 0.01) == 7.0
    low.reset()
    assert low.step(-3.0, 0.01) == -3.0


def test_roll_on_an_arc() -> None:
    # wheels of 0.1 m, track 0.5 m; left 1 rad, right 2 rad: 0.15 m on, turn (0.2 - 0.1) / 0.5 = 0.2 rad, radius 0.75 m
    pose = roll(Pose(0, 0, 0), Wheels(0, 0, 0), Wheels(1, 1, 2), radius=0.1, track=0.5)
    assert pose == pytest.approx((0.75 * math.sin(0.2), 0.75 * (1 - math.cos(0.2)), 0.2))


def odometry() -> Odometry:
    return Odometry(radius=0.1, track=0.5)


def test_knows_nothing_before_an_anchor() -> None:
    o = odometry()
    o.wheels(Wheels(1.0, 5, 5))
    assert o.pose is None


def test_anchor_counts_from_its_own_time_not_from_its_arrival() -> None:
    o = odometry()
    for i in range(11):
        o.wheels(Wheels(1 + i / 100, i, i))  # 0.1 m each
    o.anchor(1.04, Pose(2, 0, 0))
    assert o.pose == pytest.approx((2 + 6 * 0.1, 0, 0))
    o.anchor(1.095, Pose(5, 1, 0))  # half way between two samples
    assert o.pose == pytest.approx((5 + 0.05, 1, 0))


def test_anchor_ahead_of_the_wheels_waits_for_them() -> None:
    o = odometry()
    o.wheels(Wheels(1.0, 0, 0))
    o.anchor(1.5, Pose(2, 0, 0))
    assert o.pose is None
    o.wheels(Wheels(2.0, 10, 10))  # 1 m in 1 s, half of it after the anchor
    assert o.pose == pytest.approx((2.5, 0, 0))


def test_anchor_older_than_the_wheels_that_are_kept_changes_nothing() -> None:
    o = odometry()
    o.wheels(Wheels(1.0, 0, 0))
    o.anchor(1.0, Pose(2, 0, 0))
    o.anchor(0.5, Pose(7, 7, 7))
    assert o.pose == (2, 0, 0)


def test_a_late_sample_is_ignored_and_a_new_clock_starts_anew() -> None:
    o = odometry()
    o.wheels(Wheels(100.0, 0, 0))
    o.anchor(100.0, Pose(0, 0, 0))
    assert o.wheels(Wheels(100.02, 2, 2))
    assert not o.wheels(Wheels(100.01, 1, 1))
    assert o.pose == pytest.approx((0.2, 0, 0))
    assert o.wheels(Wheels(3.0, 0, 0))
    assert o.pose is None


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(st.floats(0, 0.05), st.floats(0, 0.05)), min_size=5, max_size=60), st.data())
def test_lost_samples_cost_only_the_shape_of_an_arc(steps: list[tuple[float, float]], data: st.DataObject) -> None:
    kept = data.draw(st.lists(st.booleans(), min_size=len(steps), max_size=len(steps)))
    every, some = odometry(), odometry()
    for o in (every, some):
        o.wheels(Wheels(0, 0, 0))
        o.anchor(0, Pose(0, 0, 0))
    left = right = 0.0
    for i, ((dl, dr), keep) in enumerate(zip(steps, [*kept[:-1], True], strict=True), 1):
        left, right = left + dl, right + dr
        every.wheels(Wheels(i * 0.01, left, right))
        if keep:
            some.wheels(Wheels(i * 0.01, left, right))
    assert every.pose is not None
    assert some.pose is not None
    assert some.pose.heading == pytest.approx(every.pose.heading)  # the heading depends on the angles alone
    # Way at most 0.3 m with at most 0.6 rad of turn: the chord differs from the way by a few per cent of it.
    assert math.hypot(some.pose.x - every.pose.x, some.pose.y - every.pose.y) < 0.3 * 0.6 / 2
