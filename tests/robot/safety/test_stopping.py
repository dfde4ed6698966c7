"""The stopping way, against an oracle that turns gate, guard and wheels step by step."""

import numpy as np
import pytest
from stopping_oracle import Drive, Faults, deepest

from skytether.robot.safety.config import SafetyConfig
from skytether.robot.safety.stopping import Stages, fastest, stopping_way

WALL = np.array([(6.0, y) for y in np.linspace(-1.0, 1.0, 201)])
TOLERANCE = 0.04
"""Of the motion since the scan [m]."""


def config(rate_hz: float = 50.0, guard_s: float | None = None, **limits: float) -> SafetyConfig:
    return SafetyConfig.model_validate(
        {
            "footprint": {"polygon": [[0.35, 0.25], [0.35, -0.25], [-0.3, -0.25], [-0.3, 0.25]]},
            "limits": {"linear_max": 1.5, "linear_min": -0.5, "angular_max": 1.0, "max_gap_s": 1.0} | limits,
            "sensors": {"scan": {"range_max": 50.0}},
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


@pytest.mark.parametrize("rate", [10.0, 20.0, 50.0, 100.0, 500.0])
def test_at_every_rate_the_robot_stands_before_a_wall(rate):
    # At 10 Hz a turn counted for half its time: 0.83 m/s^2 instead of 2.0, and 0.25 m of the wall in the footprint.
    drive = Drive(config(rate), WALL, lambda _: (1.5, 0.0), Faults(jitter=0.2))
    assert deepest(drive, 12.0) <= TOLERANCE
    assert drive.fastest == pytest.approx(1.5)
    assert drive.pose.x > 5.4  # it goes as near as it may: 0.35 and 0.1 before the wall, and a little


@pytest.mark.parametrize("rate", [10.0, 50.0])
def test_a_gate_that_dies_on_the_way_to_a_wall_is_no_worse(rate):
    for dies in np.arange(3.0, 5.5, 0.25):
        drive = Drive(config(rate), WALL, lambda _: (1.5, 0.0), Faults(gate_dies_at=dies))
        assert deepest(drive, 8.0) <= TOLERANCE
