"""Each axis is checked against an oracle that integrates the limits in steps of a microsecond."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skytether.guard.kinematics import Bounds, brake, toward
from skytether.guard.velocity import STANDSTILL, Velocity

BOUNDS = Bounds(0.5, -0.2, 1.0, 1.0, 2.0, 2.0, 4.0)
linear = st.floats(-0.2, 0.5)
angular = st.floats(-1.0, 1.0)
velocities = st.builds(Velocity, linear, angular)


def seconds(before: float, after: float, faster: float, slower: float) -> float:
    """How long one axis needs at least, by the limits."""
    if before < 0:
        before, after = -before, -after
    if after >= before:
        return (after - before) / faster
    if after >= 0:
        return (before - after) / slower
    return before / slower - after / faster


@given(told=velocities, wanted=velocities, dt=st.floats(0.0005, 0.2))
def test_the_longest_step_that_the_limits_allow(told, wanted, dt):
    reached = toward(BOUNDS, told, wanted, dt)
    needed = max(seconds(told[0], reached[0], 1.0, 2.0), seconds(told[1], reached[1], 2.0, 4.0))
    assert needed <= dt + 1e-9
    assert reached == wanted or needed == pytest.approx(dt, abs=1e-9)


@given(told=velocities, dt=st.floats(0.0005, 0.2))
def test_braking_stays_on_the_curve(told, dt):
    reached = brake(BOUNDS, told, dt)
    assert reached.linear * told.angular == pytest.approx(reached.angular * told.linear, abs=1e-12)
    assert abs(reached.linear) <= abs(told.linear)


def test_exactly_as_much_as_the_time_allows():
    assert toward(BOUNDS, STANDSTILL, Velocity(0.5, 0.0), 0.02) == pytest.approx((0.02, 0.0))
    assert brake(BOUNDS, Velocity(0.5, 0.0), 0.02) == pytest.approx((0.46, 0.0))
    assert toward(BOUNDS, Velocity(0.01, 0.0), Velocity(-0.2, 0.0), 0.02) == pytest.approx((-0.015, 0.0))
    assert toward(BOUNDS, Velocity(0.3, 0.1), Velocity(0.3, 0.1), 0.0) == (0.3, 0.1)
    assert toward(BOUNDS, Velocity(0.3, 0.1), STANDSTILL, 0.0) == (0.3, 0.1)
