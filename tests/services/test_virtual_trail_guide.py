import dataclasses
import math

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from skytether.control.admittance import Velocity
from skytether_services.virtual_trail.guide import Guide, end_limit, modified_torque
from skytether_services.virtual_trail.odometry import Wheels
from skytether_services.virtual_trail.params import Arc, Params, Straight
from skytether_services.virtual_trail.path import Pose

DT = 0.01
STRAIGHT = Params(trail=(Straight(5.0),))


def placed(pose: Pose, params: Params = STRAIGHT) -> Guide:
    guide = Guide(params)
    guide.wheels(Wheels(0, 0, 0), 0.0)
    guide.odometry(0, pose)
    return guide


def walk(guide: Guide, force: float, steps: int, *, start: float = 0.0) -> Velocity:
    """Steps at one place under a constant force."""
    velocity = None
    for i in range(steps):
        now = start + i * DT
        guide.force(force, now)
        guide.wheels(Wheels(now + DT, 0, 0), now)
        velocity = guide.step(now)
    assert velocity is not None
    return velocity


def test_equation_2_4() -> None:
    # 50 * 0.2 * 0.5 * tanh(0.5)
    assert modified_torque(gain=50, linear=0.2, distance=0.5, error=0.5) == pytest.approx(5 * math.tanh(0.5))


def test_end_limit_falls_creeps_and_stops() -> None:
    assert end_limit(0.2, rate=0.8, creep=0.03) == pytest.approx(0.16)
    assert end_limit(0.001, rate=0.8, creep=0.03) == 0.03
    assert end_limit(0.0, rate=0.8, creep=0.03) == 0
    assert end_limit(-1.0, rate=0.8, creep=0.03) == 0


def test_commands_nothing_before_it_knows_where_it_is() -> None:
    guide = Guide(STRAIGHT)
    guide.force(20, 0)
    guide.wheels(Wheels(0, 0, 0), 0.0)
    assert guide.step(0.0) is None
    assert guide.progress is None
    guide.odometry(0, Pose(1, 0, 0))
    assert guide.step(0.01) is not None
    assert guide.progress == pytest.approx(1.0)


def test_settles_where_equations_2_1_to_2_4_say() -> None:
    # F = 24 / 2 = 12 N (2.1), v = 12 / 60 = 0.2 m/s (2.2), error = -0.1 rad beside a straight trail,
    # tau = 50 * 0.2 * 0.5 tanh(-0.1) (2.4), omega = tau / 6 (2.3)
    velocity = walk(placed(Pose(1, 0, 0.1)), 24, 600)
    assert velocity.linear == pytest.approx(0.2)
    assert velocity.angular == pytest.approx(5 * math.tanh(-0.1) / 6)


def test_pulling_stops_and_does_not_turn() -> None:
    guide = placed(Pose(1, 0.3, 0.5))
    walk(guide, 24, 300)
    assert walk(guide, -30, 300, start=3.0) == (0, 0)


def test_stops_at_the_end_whatever_the_push() -> None:
    assert walk(placed(Pose(5.01, 0, 0)), 400, 300) == (0, 0)


def test_repeats_without_new_forces_until_they_are_too_old() -> None:
    guide = placed(Pose(1, 0, 0))
    walk(guide, 24, 600)  # last force at 5.99
    for i in range(9):
        now = 6.0 + i * DT
        guide.wheels(Wheels(now + DT, 0, 0), now)
        velocity = guide.step(now)
        assert velocity is not None
        assert velocity.linear == pytest.approx(0.2)
    guide.wheels(Wheels(7, 0, 0), 6.1)
    assert guide.step(5.99 + 0.101) is None


def test_says_nothing_when_the_wheels_fall_silent() -> None:
    guide = placed(Pose(1, 0, 0))
    walk(guide, 24, 600)
    guide.force(24, 6.1)
    assert guide.step(6.1) is None


def test_after_a_silence_it_starts_from_standstill_with_the_new_force_alone() -> None:
    guide = placed(Pose(1, 0, 0))
    walk(guide, 24, 600)
    assert guide.step(7.0) is None
    # One step of 50 ms, the longest: (15 * 0 + 3 * 0.05) / (15 + 60 * 0.05)
    guide.force(6, 8.0)
    guide.wheels(Wheels(8.0, 0, 0), 8.0)
    assert guide.step(8.0) == pytest.approx((0.15 / 18, 0))


def test_a_stalled_machine_makes_no_leap() -> None:
    guide = placed(Pose(1, 0, 0))
    walk(guide, 0, 10)
    guide.force(24, 100.0)
    guide.wheels(Wheels(100.0, 0, 0), 100.0)
    velocity = guide.step(100.0)  # 99.91 s after the last one, counted as 50 ms
    assert velocity is not None
    assert 0 < velocity.linear <= 12 * 0.05 / (15 + 60 * 0.05)


def test_progress_goes_forward_and_a_jump_of_the_odometry_finds_the_place_anew() -> None:
    guide = placed(Pose(1, 0, 0))
    walk(guide, 24, 2)
    guide.odometry(0.02, Pose(0.9, 0, 0))
    walk(guide, 24, 2, start=0.02)
    assert guide.progress == pytest.approx(1.0)
    guide.odometry(0.04, Pose(4, 0, 0))  # came back after a long gap
    walk(guide, 24, 2, start=0.04)
    assert guide.progress == pytest.approx(4.0)


@settings(max_examples=60, deadline=None)
@example([(0.0, -1e308, 0.0, 0.0), (0.0, 1e308, 0.0, 0.0)])  # finite both, and their difference is not
@given(
    st.lists(
        st.tuples(
            st.floats(allow_nan=True, allow_infinity=True),
            st.floats(allow_nan=True, allow_infinity=True),
            st.floats(-1e3, 1e3),
            st.floats(allow_nan=True, allow_infinity=True),
        ),
        min_size=1,
        max_size=30,
    )
)
def test_no_input_makes_it_leave_its_limits(inputs: list[tuple[float, float, float, float]]) -> None:
    guide = placed(Pose(1, 0, 0))
    for i, (force, angle, place, heading) in enumerate(inputs):
        now = i * DT
        guide.force(force, now)
        guide.wheels(Wheels(now, angle, 0.0), now)
        guide.odometry(now, Pose(place, 0.0, heading))
        velocity = guide.step(now)
        if velocity is not None:
            assert 0 <= velocity.linear <= 0.25
            assert -0.5 <= velocity.angular <= 0.5


def test_a_force_sensor_gone_mad_is_forgotten_within_half_a_second() -> None:
    guide = placed(Pose(1, 0, 0))
    walk(guide, 1e300, 10)
    assert walk(guide, 0, 300, start=0.1).linear < 1e-3


def test_refuses_an_arc_without_an_angle() -> None:
    with pytest.raises(ValueError, match="segment 2 must be longer than 0 m"):
        Guide(dataclasses.replace(STRAIGHT, trail=(Straight(1.0), Arc(1.0, 0.0))))
