import dataclasses
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skytether.control.admittance import STANDSTILL, AdmittanceParams, Velocity, angular_step, linear_step, step

PARAMS = AdmittanceParams(mass=10, damping=50, angular_mass=2, angular_damping=10)
DT = 0.01


def test_one_linear_step() -> None:
    # 10 (v - 0.1) / 0.01 + 50 v = 10  ->  1050 v = 110  ->  v = 11/105
    assert linear_step(PARAMS, 0.1, 10.0, DT) == pytest.approx(11 / 105)


def test_one_angular_step() -> None:
    # 2 (w + 0.2) / 0.01 + 10 w = 3  ->  210 w = -37
    assert angular_step(PARAMS, -0.2, 3.0, DT) == pytest.approx(-37 / 210)


def test_settles_at_force_over_damping_with_time_constant_mass_over_damping() -> None:
    v = 0.0
    reached = []
    for _ in range(300):
        v = linear_step(PARAMS, v, 10.0, 0.001)
        reached.append(v)
    assert reached[199] == pytest.approx(0.2 * (1 - math.exp(-1)), rel=0.005)  # after m/d = 0.2 s
    for _ in range(3000):
        v = linear_step(PARAMS, v, 10.0, 0.001)
    assert v == pytest.approx(0.2, rel=1e-6)


def test_result_satisfies_equation_2_2_with_the_acceleration_of_the_step() -> None:
    before = 0.05
    after = linear_step(PARAMS, before, 7.0, DT)
    assert after == pytest.approx((7.0 - PARAMS.mass * (after - before) / DT) / PARAMS.damping)


def test_pulling_stops_and_never_drives_backwards_and_nothing_winds_up() -> None:
    velocity = Velocity(0.1, 0.0)
    for _ in range(500):
        velocity = step(PARAMS, velocity, -100.0, 0.0, DT)
        assert velocity.linear >= 0
    assert step(PARAMS, velocity, 10.5, 0.0, DT).linear == pytest.approx(0.01)  # 1050 v = 10.5: moves at once


@given(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6), st.floats(0, 0.25), st.floats(-0.5, 0.5), st.floats(1e-6, 10.0))
def test_limits_hold_for_any_force_and_step(force: float, torque: float, v: float, w: float, dt: float) -> None:
    result = step(PARAMS, Velocity(v, w), force, torque, dt)
    assert 0 <= result.linear <= 0.25
    assert -0.5 <= result.angular <= 0.5


@pytest.mark.parametrize("name", [field.name for field in dataclasses.fields(AdmittanceParams)])
def test_params_must_be_positive(name: str) -> None:
    with pytest.raises(ValueError, match=f"{name} must be above 0"):
        AdmittanceParams(**{name: 0.0})
    assert step(AdmittanceParams(), STANDSTILL, 0.0, 0.0, DT) == STANDSTILL
