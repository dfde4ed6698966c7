"""The stopping way, against an oracle that turns gate, guard and wheels step by step."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from stopping_oracle import Drive, Faults, deepest

from skytether.robot.safety.config.safety_config import SafetyConfig
from skytether.robot.safety.geometry.stopping import Stages, fastest, stopping_way

WALL = np.array([(6.0, y) for y in np.linspace(-1.0, 1.0, 201)])
TOLERANCE = 0.002
"""Of the laser's rays, and of the steps that the oracle takes [m]."""
CURVES = 0.01
"""The same on curves, where a ray's width counts more and things hide behind each other [m]."""


def config(rate_hz: float = 50.0, guard_s: float | None = None, **limits: float) -> SafetyConfig:
    return SafetyConfig.model_validate(
        {
            "footprint": {"polygon": [[0.35, 0.25], [0.35, -0.25], [-0.3, -0.25], [-0.3, 0.25]]},
            "limits": {"linear_max": 1.5, "linear_min": -0.5, "angular_max": 1.0, "max_gap_s": 1.0} | limits,
            "sensors": {"scan": {"on_empty": "free"}},
            "rate_hz": rate_hz,
            "guard_s": guard_s or max(0.1, 2 / rate_hz),
            "sockets": {},
        }
    )


def test_the_stopping_way_is_that_of_a_constant_speed_and_then_the_brakes():
    # 1.5 m/s for 0.2 s, then 1.5^2 / (2 * 2).
    assert stopping_way(1.5, 2.0, 0.2) == pytest.approx(0.3 + 0.5625)
    assert fastest(0.8625, 2.0, 0.2) == pytest.approx(1.5)
    assert fastest(0.0, 2.0, 0.2) == fastest(-1.0, 2.0, 0.2) == 0.0


def test_the_reaction_is_the_sum_of_its_stages():
    stages = Stages(sensing_s=0.05, period_s=0.02, guard_s=0.1, writer_s=0.02, wheels_s=0.1)
    # Held for 0.1 + 2 * 0.02 + 0.02, with 0.05 and 0.1 around it.
    assert stages.hold_s == pytest.approx(0.16)
    assert stages.reaction_s(age=0.3) == pytest.approx(0.61)


@pytest.mark.parametrize(
    "rate", [10.0, 20.0, *(pytest.param(rate, marks=pytest.mark.slow) for rate in (50.0, 100.0, 500.0))]
)
def test_at_every_rate_the_robot_stands_before_a_wall(rate):
    # At 10 Hz a turn counted for half its time: 0.83 m/s^2 instead of 2.0, and 0.25 m of the wall in the footprint.
    drive = Drive(config(rate), WALL, lambda _: (1.5, 0.0), Faults(jitter=0.2))
    assert deepest(drive, 9.0) <= TOLERANCE
    assert drive.fastest == pytest.approx(1.5)
    assert drive.pose.x > 5.4  # it goes as near as it may: 0.35 and 0.1 before the wall, and a little


@pytest.mark.parametrize("rate", [10.0, pytest.param(50.0, marks=pytest.mark.slow)])
def test_a_gate_that_dies_on_the_way_to_a_wall_is_no_worse(rate):
    for dies in (3.5, 4.0, 4.5):
        drive = Drive(config(rate), WALL, lambda _: (1.5, 0.0), Faults(gate_dies_at=dies))
        assert deepest(drive, dies + 2.0) <= TOLERANCE


@pytest.mark.parametrize("see_m", [2.0, *(pytest.param(far, marks=pytest.mark.slow) for far in (1.0, 4.0))])
def test_the_robot_is_only_as_fast_as_it_can_stop_within_what_its_laser_sees(see_m):
    drive = Drive(config(), WALL, lambda _: (1.5, 0.0), see_m=see_m)
    assert deepest(drive, 4.0 + 6.0 / see_m) <= TOLERANCE
    # 0.45 m of what it sees is the footprint and the stop zone; the oldest scan is 0.15 s old.
    stages = drive.rules.stages
    assert drive.fastest <= fastest(see_m - 0.45, 2.0, stages.reaction_s(0.0)) + 0.01
    assert drive.fastest >= min(1.5, 0.9 * fastest(see_m - 0.45, 2.0, stages.reaction_s(0.15)))
    assert drive.pose.x > 5.3


@st.composite
def drives(draw: st.DrawFn, *rates: float) -> tuple[Drive, float]:
    """A robot of any kind, among things of any kind, with an agent that wants anything."""
    rate = draw(st.sampled_from(rates))
    acceleration, turning = draw(st.floats(0.3, 2.5)), draw(st.floats(0.5, 4.0))
    front, back, side = draw(st.floats(0.1, 0.6)), draw(st.floats(0.1, 0.6)), draw(st.floats(0.1, 0.4))
    robot = SafetyConfig.model_validate(
        {
            "footprint": {"polygon": [[front, side], [front, -side], [-back, -side], [-back, side]]},
            "limits": {
                "linear_max": draw(st.floats(0.1, 2.0)),
                "linear_min": draw(st.floats(-1.0, 0.0)),
                "angular_max": draw(st.floats(0.1, 2.0)),
                "linear_acceleration": acceleration,
                "angular_acceleration": turning,
                "linear_braking": acceleration * draw(st.floats(1.0, 2.0)),
                "angular_braking": turning * draw(st.floats(1.0, 2.0)),
                "max_gap_s": 1.0,
            },
            "zones": {
                "stop_m": draw(st.floats(0.05, 0.2)),
                "sensing_s": draw(st.floats(0.001, 0.15)),
                "reaction_s": draw(st.floats(0.01, 0.3)),
            },
            "sensors": {"scan": {"on_empty": "free"}},
            "rate_hz": rate,
            "guard_s": draw(st.floats(max(0.02, 2 / rate), 0.25)),
            "sockets": {},
        }
    )
    things = draw(st.lists(st.tuples(st.floats(0.0, 3.0), st.floats(-math.pi, math.pi)), min_size=1, max_size=12))
    outline = robot.rules().footprint.inflated(robot.zones.stop_m)
    found = [(outline.radius + 0.02 + far) * np.array([math.cos(a), math.sin(a)]) for far, a in things]
    legs = draw(st.lists(st.tuples(st.floats(-1.2, 2.2), st.floats(-2.2, 2.2)), min_size=1, max_size=6))
    faults = Faults(
        jitter=draw(st.floats(0.0, 0.9)),
        gate_hangs=draw(st.sampled_from([0.0, 0.0, 0.02, 0.2])),
        gate_dies_at=draw(st.sampled_from([math.inf, math.inf, draw(st.floats(0.5, 6.0))])),
        late_wheels=draw(st.booleans()),
        scan_s=draw(st.floats(0.02, 0.25)),
    )
    seconds = 1.2 * len(legs)
    drive = Drive(robot, np.array(found), lambda at: legs[min(int(at / 1.2), len(legs) - 1)], faults, draw(seeds))
    drive.rays = 7200
    drive.see_m = draw(st.sampled_from([50.0, draw(st.floats(0.5, 4.0))]))
    return drive, seconds


seeds = st.integers(0, 2**32)


@pytest.mark.slow
@settings(max_examples=60)
@given(drives(10.0, 15.0, 30.0, 50.0, 100.0, 250.0, 500.0))
def test_over_many_configurations_nothing_gets_into_the_stop_zone(drawn):
    drive, seconds = drawn
    assert deepest(drive, seconds) <= CURVES
