"""An agent whose wheels are behind a gate goes on from what the gate told them."""

from itertools import pairwise

import pytest

from skytether.control.admittance import Velocity
from skytether.robot.control.arbiter import LinkRequirements
from skytether.robot.control.control_loop import ControlLoop
from skytether.robot.control.fallback import Admittance
from skytether.robot.control.supervisor import VelocityLimits
from skytether.robot.control.wheels_feedback import WheelsFeedback

TICK = 0.01
LIMITS = VelocityLimits()
STEP = LIMITS.linear_acceleration * TICK


@pytest.fixture
def gated(base):
    base.answer = None
    base.told = lambda now: base.answer
    driver = ControlLoop(base, Admittance(), LIMITS, LinkRequirements(), 100.0)
    now = 100.0

    def run(seconds):
        nonlocal now
        for _ in range(round(seconds / TICK)):
            now += TICK
            driver.tick(now)
        return [linear for linear, _ in base.written]

    base.run, base.driver = run, driver
    base.push = 20.0
    return base


def test_without_an_answer_it_goes_by_its_own(gated):
    assert gated.run(2.0)[-1] == pytest.approx(20 / 2 / 60, abs=0.01)


def test_while_the_gate_says_stopped_a_standstill_is_sent(gated):
    gated.run(2.0)
    begin = len(gated.written)
    gated.answer = WheelsFeedback(Velocity(0.0, 0.0), 0.02, "the button was pressed", "nobody")
    assert set(gated.run(1.0)[begin:]) == {0.0}
    assert gated.driver.status().told.stopped == "the button was pressed"
    begin = len(gated.written)
    gated.answer = WheelsFeedback(Velocity(0.0, 0.0), 0.02, "", "agent")
    assert max(gated.run(0.5)[begin:]) <= LIMITS.linear_braking * (0.02 + 2 * TICK) + STEP


def test_it_is_never_far_from_what_the_wheels_were_told(gated):
    gated.run(2.0)
    for told in (0.05, 0.0, 0.1):
        gated.answer = WheelsFeedback(Velocity(told, 0.0), 0.03, "", "agent")
        reached = gated.run(0.3)[-1]
        assert abs(reached - told) <= LIMITS.linear_braking * (0.03 + 2 * TICK) + STEP


def test_a_gate_that_follows_is_no_hindrance(gated):
    """It answers 30 ms late what it was told then: the robot gets as fast as without it."""
    late = [Velocity(0.0, 0.0)] * 3
    for _ in range(200):
        gated.answer = WheelsFeedback(late.pop(0), 0.0, "", "agent")
        gated.run(TICK)
        late.append(Velocity(*gated.written[-1]))
    told = [linear for linear, _ in gated.written]
    assert told[-1] == pytest.approx(20 / 2 / 60, abs=0.01)
    assert all(abs(b - a) <= STEP + 1e-9 for a, b in pairwise(told))
