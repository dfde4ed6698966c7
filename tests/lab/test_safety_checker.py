"""The judge of what wheels were told finds every violation that is made up, and none in a good record."""

from __future__ import annotations

from dataclasses import replace
from math import inf, nan

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skytether.control.admittance import Velocity
from skytether.lab.safety.checker import Demand, SentVelocity, Wheels, check, tightest
from skytether.lab.safety.socket_hardware import steady
from skytether.robot.control.supervisor import VelocityLimits

PERIOD = 0.02
LIMITS = VelocityLimits(linear_max=0.5, linear_min=-0.1, angular_max=0.8)  # 1 and 2 m/s^2, 2 and 4 rad/s^2
WHEELS = Wheels(LIMITS, silence_s=0.1, jitter_s=PERIOD)


def drive(*legs, start=0.0, last=0.0):
    """A record at 50 Hz: each leg goes to a velocity as fast as is allowed, and keeps it for some seconds."""
    told, at, linear = [], start, last
    for target, seconds in legs:
        end = at + seconds
        while at < end - 1e-9:
            limit = LIMITS.linear_acceleration if abs(target) > abs(linear) else LIMITS.linear_braking
            change = limit * PERIOD
            linear += max(-change, min(change, target - linear))
            told.append(SentVelocity(at, Velocity(linear, 0.0)))
            at += PERIOD
    return told


def kinds(record, *demands):
    return [violation.kind for violation in check(record, demands, WHEELS).violations]


def test_a_good_drive_has_no_violation():
    record = drive((0.5, 2.0), (0.0, 1.0), (-0.1, 0.5), (0.5, 1.0), (0.0, 1.0))
    finding = check(record, [Demand(2.0, 0.3, 2.9, "braked")], WHEELS)
    assert finding.violations == ()
    assert finding.velocity_max == pytest.approx(0.5)
    assert 0.9 < finding.acceleration_max < 2.0
    assert finding.standstill == (pytest.approx(0.24, abs=0.021), 0.3)


@settings(max_examples=10)
@given(st.lists(st.floats(-0.015, 0.0), min_size=200, max_size=200))
def test_a_clock_that_is_read_a_little_before_sending_is_no_violation(early):
    record = drive((0.5, 1.0), (0.0, 1.0), (0.5, 2.0))
    shifted = [SentVelocity(told.at + shift, told.velocity) for told, shift in zip(record, early, strict=True)]
    assert kinds(sorted(shifted, key=lambda told: told.at)) == []


@pytest.mark.parametrize("velocity", [Velocity(0.6, 0.0), Velocity(-0.2, 0.0), Velocity(0.0, 0.9), Velocity(5.0, 0.0)])
def test_too_fast(velocity):
    assert "velocity" in kinds([SentVelocity(0.0, velocity), SentVelocity(0.02, velocity)])


@pytest.mark.parametrize("bad", [nan, inf, -inf])
def test_no_number(bad):
    record = drive((0.5, 1.0))
    assert kinds([*record, SentVelocity(1.0, Velocity(bad, 0.0)), SentVelocity(1.02, Velocity(0.5, bad))]) == ["number"]


def test_a_jump_up_and_down():
    record = drive((0.5, 1.0))
    up = [SentVelocity(0.0, Velocity(0.0, 0.0)), SentVelocity(0.009, Velocity(0.41, 0.0))]
    down = [*record, SentVelocity(1.0, Velocity(0.0, 0.0))]
    turn = [SentVelocity(0.0, Velocity(0.0, 0.0)), SentVelocity(0.02, Velocity(0.0, 0.5))]
    back = [*drive((0.3, 1.0)), SentVelocity(1.0, Velocity(-0.1, 0.0))]
    for jump in (up, down, turn, back):
        assert kinds(jump) == ["acceleration"]
    assert check(up, [], WHEELS).acceleration_max == pytest.approx(0.41 / 0.029)


def test_a_judge_that_was_held_up_blames_nobody_and_sees_a_jump_all_the_same():
    """On a graph: for 0.15 s nothing was taken, then all at once; the times between are not known."""
    record = drive((0.5, 1.0), (0.0, 0.5))
    late = [t if not 1.0 < t.at < 1.15 else SentVelocity(1.15, t.velocity, earliest=1.0) for t in record]
    assert kinds([SentVelocity(t.at, t.velocity) for t in late]) == ["acceleration"]
    assert kinds(late) == []
    jump = [*drive((0.5, 1.0)), SentVelocity(1.0, Velocity(0.0, 0.0), earliest=0.99)]
    assert kinds(jump) == ["acceleration"]


def test_a_change_that_is_too_fast_in_small_steps_does_not_hide_in_the_tolerance():
    """1.5 m/s^2 where 1 is allowed: each step is within the tolerance, all together are not."""
    record = [SentVelocity(PERIOD * i, Velocity(min(0.5, 1.5 * PERIOD * i), 0.0)) for i in range(50)]
    assert kinds(record) == ["acceleration"]


def test_after_silence_the_robot_stands():
    """Wheels that heard nothing have stopped: whoever speaks to them again begins from there."""
    record = drive((0.5, 1.0))
    assert kinds([*record, *drive((0.5, 1.0), start=1.3, last=0.5)]) == ["acceleration"]
    assert kinds([*record, *drive((0.5, 1.0), start=1.3)]) == []
    # On the edge nobody knows whether they have stopped.
    assert kinds([*record, *drive((0.5, 1.0), start=1.08, last=0.5)]) == []
    assert kinds([*record, *drive((0.5, 1.0), start=1.08)]) == []
    assert kinds([*record, SentVelocity(1.08, Velocity(0.25, 0.0))]) == ["acceleration"]
    # Somebody else took over just before they stopped, and brakes: right all the way down.
    assert kinds([*record, *drive((0.0, 1.0), start=1.085, last=0.3)]) == []


def test_standstill_that_is_late_or_never_comes():
    record = drive((0.5, 2.0), (0.0, 1.0))
    late = check(record, [Demand(1.7, 0.4, 2.9, "killed")], WHEELS)
    assert [violation.kind for violation in late.violations] == ["standstill"]
    assert late.standstill == (pytest.approx(0.54, abs=0.021), 0.4)
    never = check(drive((0.5, 3.0)), [Demand(1.0, 0.4, 3.0, "killed")], WHEELS)
    assert [violation.kind for violation in never.violations] == ["standstill"]
    assert never.standstill == (pytest.approx(2.0), 0.4)
    assert kinds(record, Demand(2.0, 0.4, 2.9, "killed")) == []


def test_silence_is_a_standstill_after_a_while():
    record = drive((0.5, 1.0))
    finding = check(record, [Demand(0.95, 0.2, 2.0, "all killed")], WHEELS)
    assert finding.violations == ()
    assert finding.standstill == (pytest.approx(0.13, abs=0.011), 0.2)
    assert kinds(record, Demand(0.95, 0.1, 2.0, "all killed")) == ["standstill"]


def test_a_robot_that_moves_again_by_itself():
    pulse = drive((0.5, 1.0), (0.0, 1.0), (0.04, 0.1), (0.0, 1.0))
    assert kinds(pulse, Demand(1.0, 0.4, 3.0, "stopped")) == ["motion"]
    assert kinds(pulse, Demand(1.5, 0.0, 3.0, "stopped")) == ["motion"]
    assert kinds(pulse, Demand(1.0, 0.4, 2.0, "stopped")) == []


def test_what_may_have_begun_after_the_demand_is_no_motion():
    """A frozen one goes on right after it; what it says first may have waited for some milliseconds, or not."""
    record = [replace(told, earliest=told.at - 0.007) for told in drive((0.0, 2.0), (0.5, 1.0))]
    began = next(told for told in record if told.velocity.linear)
    assert kinds(record, Demand(1.0, 0.4, began.at - 0.001, "frozen")) == []
    assert kinds(record, Demand(1.0, 0.4, began.at + 0.001, "frozen")) == ["motion"]


def test_turning_on_the_spot_is_no_standstill():
    record = [SentVelocity(PERIOD * i, Velocity(0.0, 0.02)) for i in range(50)]
    assert kinds(record, Demand(0.0, 0.2, 0.9, "stopped")) == ["standstill"]


def test_a_robot_that_should_be_slow():
    record = drive((0.5, 1.0), (0.1, 1.0), (0.5, 1.0))
    assert kinds(record, Demand(1.0, 0.3, 2.0, "blind", speed=0.1)) == []
    assert kinds(record, Demand(1.0, 0.3, 3.0, "blind", speed=0.1)) == ["velocity"]
    assert check(record, [Demand(1.0, 0.3, 2.0, "blind", speed=0.1)], WHEELS).standstill is None


def test_the_standstill_with_the_least_to_spare_is_told():
    assert tightest([(0.3, 0.5), (0.25, 0.3), (0.1, 0.2)]) == (0.25, 0.3)
    assert tightest([(0.3, 0.5), (0.7, 0.5)]) == (0.7, 0.5)
    assert tightest([]) is None


def test_a_judge_that_loses_the_processor_between_two_clocks_does_not_date_a_velocity_earlier() -> None:
    time = 0.0
    held_up = iter([0.0, 0.17, 0.0, 0.0, 0.0])

    def clock() -> float:
        nonlocal time
        read = time
        time += next(held_up) or 1e-6
        return read

    assert steady(1000.0, clock, lambda: 1000.1 + clock()) == pytest.approx(-0.1, abs=1e-4)
