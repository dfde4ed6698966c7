from importlib.metadata import EntryPoint, EntryPoints
from math import nan

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skytether.control.admittance import AdmittanceParams, Velocity
from skytether.messages import Twist, Vector3, Wrench, WrenchStamped
from skytether.robot.control import fallback
from skytether.robot.control.fallback import Admittance, FallbackError, Reading, Stop, load


def force(x: float, torque: float = 0.0) -> dict[str, Reading]:
    return {"force": Reading(WrenchStamped(wrench=Wrench(force=Vector3(x=x), torque=Vector3(z=torque))), 4.0)}


def test_stop_wants_nothing():
    assert Stop().step(Velocity(0.2, 0.1), force(100.0), 0.01) is None
    assert not Stop.drives


def test_admittance_settles_at_force_over_damping():
    velocity = Velocity(0.0, 0.0)
    for _ in range(500):
        velocity, read_at = Admittance(damping=60.0, angular_damping=6.0).step(velocity, force(12.0, 1.2), 0.01)
        assert read_at == 4.0
    # F = 12 N / 2 = 6 N of mean force, 6 / 60 = 0.1 m/s; 1.2 N m / 6 = 0.2 rad/s (eq. 2.2, 2.3 at rest).
    assert velocity == pytest.approx((0.1, 0.2), abs=1e-4)


@given(st.floats(0, 0.25), st.floats(-0.5, 0.5), st.floats(-200, 200), st.floats(-50, 50))
def test_taking_over_goes_on_from_the_velocity_that_the_wheels_have(linear, angular, pull, torque):
    params = AdmittanceParams()
    (v, w), _ = Admittance().step(Velocity(linear, angular), force(pull, torque), 0.01)
    # m dv = (F - d v) dt: at most (|F| + d v) dt / m in one step, however different the other source was.
    assert abs(v - linear) <= (abs(pull / 2) + params.damping * linear) * 0.01 / params.mass + 1e-12
    assert (
        abs(w - angular) <= (abs(torque) + params.angular_damping * abs(angular)) * 0.01 / params.angular_mass + 1e-12
    )


@pytest.mark.parametrize("readings", [{}, force(nan), force(1.0, nan), {"force": Reading(Twist(), 0.0)}])
def test_admittance_says_nothing_without_a_force_it_can_use(readings):
    assert Admittance().step(Velocity(0.1, 0.0), readings, 0.01) is None


def test_fallbacks_are_found_by_name_with_their_options():
    assert isinstance(load("stop", {}), Stop)
    assert isinstance(load("admittance", {"mass": 9.0}), Admittance)


@pytest.mark.parametrize(
    ("name", "options", "sentence"),
    [
        ("levitate", {}, "there is no fallback 'levitate'; known are: admittance, broken, missing, (path, )?stop"),
        ("admittance", {"mass": -1.0}, "fallback 'admittance' refuses its options: admittance: mass must be above 0"),
        ("admittance", {"weight": 1.0}, "refuses its options: .*weight"),
        ("broken", {}, "fallback 'broken' cannot be loaded from nowhere.to.be:found: No module named 'nowhere'"),
        (
            "missing",
            {},
            "fallback 'missing' cannot be loaded from skytether.robot.control.fallback:Missing: .*no attribute",
        ),
    ],
)
def test_what_cannot_be_had_is_told_in_a_sentence(monkeypatch, name, options, sentence):
    own = fallback.entry_points(group=fallback.GROUP)
    more = [
        EntryPoint("broken", "nowhere.to.be:found", fallback.GROUP),
        EntryPoint("missing", "skytether.robot.control.fallback:Missing", fallback.GROUP),
    ]
    monkeypatch.setattr(fallback, "entry_points", lambda group: EntryPoints([*own, *more]))
    with pytest.raises(FallbackError, match=sentence):
        load(name, options)
