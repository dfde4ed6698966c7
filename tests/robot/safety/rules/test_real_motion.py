"""The gate with wheels that do other things than they are told: it stops, latches and says why."""

from dataclasses import replace
from itertools import pairwise

import pytest
from played_wheels import Wheels, odometry

from skytether.guard.velocity import STANDSTILL, Velocity
from skytether.messages import Twist, Vector3
from skytether.robot.control.command import Command, Hand
from skytether.robot.control.supervisor import VelocityLimits
from skytether.robot.safety.geometry.footprint import circle
from skytether.robot.safety.rules.motion import MotionParams
from skytether.robot.safety.rules.real_motion import Handover, OdometryRules
from skytether.robot.safety.rules.rules import Gate, GateDecision, Rules
from skytether.robot.safety.rules.sources import SourceParams, SourceRules
from skytether.robot.safety.sensing.coverage import Action, UnseenParams

TURN = 0.02
LIMITS = VelocityLimits(linear_max=0.5, linear_min=-0.2, angular_max=1.0, period_s=TURN, max_step_s=0.1)
ODOMETRY = OdometryRules()
RULES = Rules(
    footprint=circle(0.3),
    limits=LIMITS,
    sources=SourceRules(further={"nav_vel": SourceParams("navigation", 20)}),
    odometry=ODOMETRY,
    unseen=UnseenParams(action=Action.FREE),
)


class Robot:
    """Wheels that follow late, on a gate; odometry at every other turn."""

    def __init__(self, rules: Rules = RULES, wheels: Wheels | None = None) -> None:
        self.gate, self.wheels = Gate(rules), wheels or Wheels(noise=0.5)
        self.now, self.turns = 100.0, 0
        self.odometry = True
        self.last = self.drive(0.0, 0.5)

    def drive(self, linear: float, seconds: float = TURN, angular: float = 0.0) -> GateDecision:
        for _ in range(round(seconds / TURN)):
            self.now += TURN
            self.turns += 1
            self.wheels.roll(self.now, TURN)
            if self.odometry and self.turns % 2:
                self.gate.sense("odom", odometry(*self.wheels.reading(self.now), self.now), self.now)
            self.gate.command(Command(Hand.AGENT, linear, angular, 1, self.turns, self.now, 0.0, self.now), self.now)
            self.last = self.gate.step(self.now)
            self.wheels.write(self.last.velocity, self.now)
        return self.last


def test_wheels_that_follow_drive():
    robot = Robot()
    for linear, angular in [(0.5, 0.0), (-0.2, 1.0), (0.0, 0.0), (0.5, -1.0)]:
        assert robot.drive(linear, 3.0, angular).velocity == (linear, angular)
    assert not robot.gate.stopped


@pytest.mark.parametrize(
    ("fault", "wanted", "says"),
    [
        (lambda _: Velocity(0.7, 0.0), 0.4, "the wheels do not do what they were told: it drives at"),
        (lambda _: Velocity(0.4, 0.0), 0.0, "the wheels do not brake"),
        (lambda _: STANDSTILL, 0.4, "the wheels do not move"),
    ],
)
def test_a_fault_stops_the_robot_until_a_reset_and_is_named(fault, wanted, says):
    robot = Robot()
    robot.drive(0.4, 2.0)
    robot.wheels.fault = fault
    robot.drive(wanted, 4.0)
    assert robot.last.velocity == STANDSTILL
    assert says in robot.gate.stopped
    robot.wheels.fault = None
    robot.drive(0.0, 2.0)
    assert robot.gate.stopped  # it is latched
    assert robot.gate.reset(robot.now) == ""
    robot.drive(0.0, 0.5)
    assert robot.drive(0.4, 2.0).velocity == (0.4, 0.0)


def test_a_robot_that_moves_while_it_was_told_to_stand_is_stopped():
    robot = Robot()
    robot.drive(0.0, 2.0)
    robot.wheels.fault = lambda _: Velocity(0.2, 0.0)
    robot.drive(0.0, 2.0)
    assert "moves while it was told to stand" in robot.gate.stopped


def test_a_fault_may_be_named_only():
    robot = Robot(replace(RULES, odometry=replace(ODOMETRY, latches=False)))
    robot.drive(0.4, 2.0)
    robot.wheels.fault = lambda _: STANDSTILL
    named = [robot.drive(0.4).troubles for _ in range(200)]
    assert any("the wheels do not move" in troubles.get("odometry:blocked", "") for troubles in named)
    assert not robot.gate.stopped


@pytest.mark.parametrize(("action", "speed"), [(Action.STOP, 0.0), (Action.SLOW, 0.1), (Action.FREE, 0.4)])
def test_odometry_that_is_silent_does_what_is_configured(action, speed):
    robot = Robot(replace(RULES, odometry=replace(ODOMETRY, on_unknown=action)))
    robot.drive(0.4, 2.0)
    robot.odometry = False
    assert robot.drive(0.4, 2.0).velocity.linear == pytest.approx(speed)
    assert ("odometry:unknown" in robot.last.troubles) is (action is not Action.FREE)
    robot.odometry = True
    assert robot.drive(0.4, 2.0).velocity.linear == pytest.approx(0.4)


def test_a_message_of_another_type_is_named_and_is_silence():
    robot = Robot()
    robot.drive(0.4, 2.0)
    robot.odometry = False
    for _ in range(50):
        robot.gate.sense("odom", odometry(float("nan"), 0.0, robot.now), robot.now)
        robot.drive(0.4)
    assert robot.last.velocity == STANDSTILL
    assert "no number" in robot.last.troubles["odometry:unknown"]


def test_a_new_driver_begins_at_what_the_wheels_do():
    """Held back by a threshold at 0.15 m/s, told 0.4: the one who takes over rises from 0.15, and nothing leaps."""
    robot = Robot(replace(RULES, odometry=replace(ODOMETRY, from_measured=True)), Wheels(noise=0.0))
    for _ in range(10):
        robot.gate.sense("nav_vel", Twist(), robot.now)
        robot.drive(0.0, 0.1)
    robot.wheels.fault = lambda v: Velocity(min(v.linear, 0.15), v.angular)
    robot.drive(0.4, 2.0)
    told = []
    for _ in range(40):
        robot.gate.sense("nav_vel", Twist(linear=Vector3(x=0.4)), robot.now)
        told.append(robot.drive(0.4).velocity.linear)
    assert robot.last.hand == "navigation"
    # It brakes at 2 m/s^2 and meets, a little above 0.15, what rises from there at 1 m/s^2.
    assert 0.15 <= min(told) <= 0.25
    assert told[-1] == pytest.approx(0.4)
    steps = [later - earlier for earlier, later in pairwise(told)]
    assert max(steps) <= LIMITS.linear_acceleration * TURN + 1e-9
    assert min(steps) >= -LIMITS.linear_braking * TURN - 1e-9


LIMIT_TOLERANCE = Velocity(0.05, 0.1)


def test_a_hand_over_falls_to_the_measured_velocity_and_rises_from_there():
    handover = Handover(LIMITS, LIMIT_TOLERANCE)
    told, measured = Velocity(0.4, 0.2), Velocity(0.1, 0.2)
    handover.update("agent", told, measured, 10.0)
    # From 0.1 m/s at 1 m/s^2; the curve is kept.
    assert handover.share(told, 10.0) == pytest.approx(0.25)
    assert handover.share(told, 10.1) == pytest.approx(0.5)
    assert handover.share(told, 10.3) == 1.0
    handover.update("agent", told, STANDSTILL, 10.31)  # the same driver
    assert handover.share(told, 10.31) == 1.0


@pytest.mark.parametrize(
    "measured",
    [None, Velocity(0.4, 0.0), Velocity(0.5, 0.0), Velocity(0.36, 0.05)],
)
def test_a_hand_over_is_not_faster_than_told_and_noise_is_none(measured):
    handover = Handover(LIMITS, LIMIT_TOLERANCE)
    handover.update("agent", Velocity(0.4, 0.0), measured, 10.0)
    assert handover.share(Velocity(0.4, 0.0), 10.0) == 1.0


def test_the_window_is_computed_from_the_configuration():
    assert MotionParams(latency_s=0.1, dead_s=0.2, lag_s=0.15).window_s == pytest.approx(0.9)
