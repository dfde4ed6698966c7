"""The order before the wheels, with made-up time: what is said, what is done, and that nothing unsafe comes out."""

import logging
import math
from dataclasses import replace
from math import inf, isfinite, nan

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skytether.control.admittance import STANDSTILL, Velocity
from skytether.messages import Bool, Header, Joy, LaserScan, Time, Twist
from skytether.robot.control.command import Command, Hand
from skytether.robot.control.supervisor import Objection, VelocityLimits
from skytether.robot.log_throttle import LogThrottle
from skytether.robot.safety.geometry.footprint import Points, polygon
from skytether.robot.safety.rules.estop import ButtonParams
from skytether.robot.safety.rules.joystick import JoystickParams
from skytether.robot.safety.rules.rules import Gate, GateDecision, Rules
from skytether.robot.safety.rules.sources import SourceRules
from skytether.robot.safety.rules.zones import Zone, ZoneParams
from skytether.robot.safety.sensing.coverage import Action
from skytether.robot.safety.sensing.ranges import Mount
from skytether.robot.safety.sensing.sensing import RangeSensor

FOOTPRINT = polygon([(0.3, 0.25), (0.3, -0.25), (-0.3, -0.25), (-0.3, 0.25)])
LIMITS = VelocityLimits(linear_max=0.5, linear_min=-0.2, angular_max=1.0)
RULES = Rules(
    footprint=FOOTPRINT,
    limits=LIMITS,
    zones=ZoneParams(),
    sensors={"scan": RangeSensor(Mount(max_gap=math.radians(10)))},
    sources=SourceRules(
        joystick=JoystickParams(deadman=0, linear_axis=0, angular_axis=1, linear=0.2, angular=0.4, deadzone=0.0),
        button=ButtonParams(),
    ),
)
PERIOD = LIMITS.period_s
RAYS = 360


def laser(points: Points, far: float = 8.0) -> LaserScan:
    """What a laser at the origin that sees all around reports of points, each a third of a metre wide; else 5 m."""
    ranges = np.full(RAYS, 5.0)
    for x, y in points:
        ray = round(math.degrees(math.atan2(y, x))) % 360
        ranges[ray] = min(ranges[ray], math.hypot(x, y))
    return LaserScan(
        angle_min=0.0,
        angle_increment=math.radians(1),
        range_min=0.05,
        range_max=far,
        ranges=ranges.astype(np.float32),
    )


def joy(*axes: float, held: bool = True) -> Joy:
    return Joy(axes=np.array(axes, dtype=np.float32), buttons=np.array([held], dtype=np.int32))


class Bench:
    """A gate with healthy sensors and an agent that wants something, unless a test says otherwise."""

    def __init__(self, rules: Rules = RULES) -> None:
        self.gate = Gate(rules)
        self.now = 100.0
        self.points: Points = np.empty((0, 2))
        self.scans = self.buttons = self.commands = True
        self.sequence = self.unrest = 0
        self.wanted = (0.3, 0.0)
        self.last: GateDecision | None = None
        self.neutral()

    def neutral(self) -> None:
        """Agent and joystick begin from a standstill."""
        for now in (self.now - 0.4, self.now - 0.3, self.now - 0.2):
            self.sequence += 1
            self.gate.command(Command(Hand.AGENT, 0.0, 0.0, 1, self.sequence, now, 0.0, now), now)
            self.gate.sense("joy", joy(0.0, 0.0, held=False), now)

    def pad(self, *axes: float) -> None:
        """A hand on the stick, which is never quite still."""
        self.unrest += 1
        self.gate.sense("joy", joy(*axes, 0.001 * (self.unrest % 2)), self.now)

    def run(self, seconds: float = PERIOD) -> GateDecision:
        for _ in range(round(seconds / PERIOD)):
            self.now += PERIOD
            if self.scans:
                self.gate.sense("scan", laser(self.points), self.now)
            if self.buttons:
                self.gate.sense("estop", Bool(data=False), self.now)
            if self.commands:
                self.send(*self.wanted)
            self.last = self.gate.step(self.now)
        assert self.last is not None
        return self.last

    def send(self, linear: float, angular: float, **changes: float) -> Objection | None:
        self.sequence += 1
        command = Command(Hand.AGENT, linear, angular, 1, self.sequence, self.now, 0.0, self.now)
        return self.gate.command(replace(command, **changes), self.now)


def test_with_all_well_the_agent_drives():
    bench = Bench()
    # 0.3 m/s at 1 m/s^2: there after 0.3 s.
    assert bench.run(0.2).velocity == pytest.approx((0.2, 0.0))
    decision = bench.run(0.2)
    assert decision.velocity == pytest.approx((0.3, 0.0))
    assert (decision.hand, decision.zone, decision.troubles) == (Hand.AGENT, Zone.CLEAR, {})


def test_without_commands_the_robot_stops_and_stays():
    bench = Bench()
    bench.run(0.5)
    bench.commands = False
    # 0.15 s of patience, then 0.3 m/s at 2 m/s^2.
    assert bench.run(0.14).velocity == pytest.approx((0.3, 0.0))
    decision = bench.run(0.18)
    assert decision.velocity == STANDSTILL
    assert "too old" in decision.troubles["agent:gap"]
    assert bench.run(1.0).velocity == STANDSTILL


@pytest.mark.parametrize("bad", [nan, inf, -inf])
def test_a_velocity_that_is_no_number_is_refused_and_named(bad):
    bench = Bench()
    bench.run(0.5)
    assert bench.send(bad, 0.0) is Objection.NOT_FINITE
    assert bench.send(0.1, bad) is Objection.NOT_FINITE
    assert "NaN or infinite" in bench.run().troubles["command:agent:not_finite"]
    assert bench.run().velocity == pytest.approx((0.3, 0.0))  # the last good one still holds


def test_before_a_wall_it_slows_down_stops_and_does_not_touch():
    bench = Bench()
    bench.wanted = (0.5, 0.0)
    wall, x, speeds = 1.5, 0.0, []
    for _ in range(750):
        bench.points = np.array([(wall - x, dy) for dy in np.linspace(-1, 1, 9)])
        speeds.append(bench.run().velocity.linear)
        x += speeds[-1] * PERIOD
    assert max(speeds) == pytest.approx(0.5)
    assert speeds[-1] == 0.0
    # Front at 0.3, stop zone 0.1: it stands at 1.1 m, and a few millimetres before.
    assert 1.07 <= x <= 1.1
    assert bench.last.zone is Zone.STOP
    # Back is free, and allowed.
    bench.wanted = (-0.2, 0.0)
    assert bench.run(0.5).velocity.linear == pytest.approx(-0.2)


def test_somebody_who_steps_into_the_stop_zone_stops_it_as_fast_as_it_may():
    bench = Bench()
    bench.run(1.0)
    bench.points = np.array([[0.35, 0.0]])
    # 0.3 m/s at 2 m/s^2: 0.15 s.
    assert bench.run(0.14).velocity.linear == pytest.approx(0.02)
    assert bench.run(0.02).velocity == STANDSTILL
    bench.points = np.empty((0, 2))
    assert bench.run(0.5).velocity == pytest.approx((0.3, 0.0))


@pytest.mark.parametrize(
    ("scan", "kind"),
    [
        (LaserScan(), "nonsense"),
        (replace(laser([]), ranges=np.zeros(RAYS, dtype=np.float32)), "blind"),
        (replace(laser([]), ranges=np.full(RAYS, nan, dtype=np.float32)), "blind"),
        (Twist(), "nonsense"),
    ],
)
def test_a_laser_that_does_not_see_stops_the_robot(scan, kind):
    bench = Bench()
    bench.run(1.0)
    bench.scans = False
    for _ in range(20):
        bench.gate.sense("scan", scan, bench.now)
        bench.run()
    assert bench.last.velocity == STANDSTILL
    assert f"scan: is {kind}" in bench.last.troubles[f"sensor:scan:{kind}"]
    bench.scans = True
    assert bench.run(1.0).velocity == pytest.approx((0.3, 0.0))


def test_a_laser_that_is_silent_or_was_never_heard_stops_the_robot():
    bench = Bench()
    bench.run(1.0)
    bench.scans = False
    assert bench.run(0.29).velocity == pytest.approx((0.3, 0.0))
    assert "silent for" in bench.run(0.2).troubles["sensor:scan:stale"]
    assert bench.last.velocity == STANDSTILL
    fresh = Bench()
    fresh.scans = False
    assert fresh.run(0.5).velocity == STANDSTILL
    assert "nothing has come yet" in fresh.last.troubles["sensor:scan:stale"]


def test_a_laser_that_repeats_one_scan_is_silent():
    bench = Bench()
    bench.run(1.0)
    bench.scans = False
    frozen = replace(laser([]), header=Header(stamp=Time(sec=5, nanosec=1)))
    for _ in range(60):
        bench.gate.sense("scan", frozen, bench.now)
        bench.run()
    assert bench.last.velocity == STANDSTILL
    assert "same reading again" in bench.last.troubles["sensor:scan:repeated"]


def test_a_laser_that_sees_nothing_anywhere_slows_the_robot():
    bench = Bench()
    bench.scans = False
    for _ in range(200):
        bench.gate.sense("scan", replace(laser([]), ranges=np.full(RAYS, inf, dtype=np.float32)), bench.now)
        bench.run()
    assert bench.last.velocity.linear == pytest.approx(0.1)
    assert "goes slowly" in bench.last.troubles["sensor:scan:empty"]


def test_a_sensor_may_be_configured_to_slow_down_only():
    sensor = replace(RULES.sensors["scan"], on_unknown=Action.SLOW)
    bench = Bench(replace(RULES, sensors={"scan": sensor}))
    bench.scans = False
    assert bench.run(1.0).velocity.linear == pytest.approx(0.1)


def test_of_two_agents_the_one_that_was_started_last_is_followed_and_the_other_named():
    bench = Bench()
    bench.run(0.5)
    for sequence in range(1, 100):
        bench.gate.command(Command(Hand.AGENT, -0.1, -0.5, 0, sequence, bench.now, 0.0, bench.now), bench.now)
        last = bench.run(PERIOD)
        assert last.velocity.linear > 0
    assert "of two agents only the one that was started last is followed" in str(last.troubles)


def test_the_joystick_goes_before_the_agent_and_gives_back():
    bench = Bench()
    bench.run(1.0)
    for _ in range(100):
        bench.pad(-0.5, 1.0)
        bench.run()
    assert bench.last.hand is Hand.JOYSTICK
    assert bench.last.velocity == pytest.approx((-0.1, 0.4))
    bench.gate.sense("joy", joy(0.0, 0.0, held=False), bench.now)
    assert bench.run(1.0).hand is Hand.AGENT
    assert bench.last.velocity == pytest.approx((0.3, 0.0))


def test_the_joystick_is_held_back_by_the_zones_as_well():
    bench = Bench()
    bench.points = np.array([[0.38, 0.0]])
    for _ in range(100):
        bench.pad(1.0, 0.0)
        bench.run()
    assert (bench.last.hand, bench.last.velocity) == (Hand.JOYSTICK, STANDSTILL)


def test_a_joystick_lost_with_the_button_held_stops_the_robot_for_good():
    bench = Bench()
    for _ in range(50):
        bench.pad(1.0, 0.0)
        bench.run()
    assert bench.run(2.0).velocity == STANDSTILL
    assert bench.last.hand is Hand.NOBODY
    assert "fell silent" in bench.last.troubles["joystick"]
    for _ in range(50):
        bench.pad(1.0, 0.0)
        assert bench.run().velocity == STANDSTILL  # it is heard again, and its button was never let go
    bench.gate.sense("joy", joy(0.0, 0.0, held=False), bench.now)
    assert bench.run(1.0).velocity == STANDSTILL  # nor does the agent go on by itself
    assert "the joystick was lost" in bench.last.troubles["agent:neutral"]
    bench.wanted = (0.0, 0.0)
    bench.run(0.3)
    bench.wanted = (0.3, 0.0)
    assert bench.run(1.0).velocity == pytest.approx((0.3, 0.0))


def test_an_emergency_stop_is_latched_and_a_reset_alone_moves_nothing():
    bench = Bench()
    bench.run(1.0)
    bench.gate.sense("estop", Bool(data=True), bench.now)
    assert bench.run(0.2).velocity == STANDSTILL  # the button is up again, the stop stays
    assert "button was pressed" in bench.last.troubles["stopped"]
    for _ in range(50):
        bench.pad(1.0, 0.0)
        assert bench.run().velocity == STANDSTILL  # nor does the joystick go past it
    bench.gate.sense("joy", joy(0.0, 0.0, held=False), bench.now)
    bench.commands = False
    bench.run()
    assert "comes first" in bench.gate.start(bench.now)[1]
    assert bench.gate.reset(bench.now) == ""
    assert bench.run(0.05).velocity == STANDSTILL
    bench.commands = True
    assert bench.run(0.5).velocity == STANDSTILL
    assert "skytether robot start" in bench.last.troubles["agent:neutral"]
    assert bench.gate.start(bench.now) == (["agent"], "")
    assert bench.run(0.5).velocity == pytest.approx((0.3, 0.0))


def test_a_reset_while_the_button_is_pressed_is_refused():
    bench = Bench()
    bench.gate.sense("estop", Bool(data=True), bench.now)
    assert "still pressed" in bench.gate.reset(bench.now)
    assert bench.gate.stopped


def test_a_silent_button_stops_without_latching():
    bench = Bench()
    bench.run(1.0)
    bench.buttons = False
    assert bench.run(1.0).velocity == STANDSTILL
    assert "not heard" in bench.last.troubles["button"]
    bench.buttons = True
    assert bench.run(0.5).velocity == pytest.approx((0.3, 0.0))


def test_a_gate_may_start_stopped():
    gate = Gate(RULES, "it was stopped when it ended")
    assert "it was stopped" in gate.step(0.0).troubles["stopped"]


@pytest.mark.parametrize("jump", [-1000.0, -0.5, 1000.0, nan, inf, -inf])
def test_a_clock_that_jumps_stops_the_robot_and_it_recovers(jump):
    bench = Bench()
    bench.run(1.0)
    before = bench.last.velocity.linear
    after = bench.gate.step(bench.now + jump).velocity
    assert 0 <= after.linear < before
    if isfinite(jump):
        bench.now += jump
        bench.run(3.0)
        assert bench.last.velocity == pytest.approx((0.3, 0.0))


def test_each_trouble_is_named_once(caplog):
    bench, notices = Bench(), LogThrottle(logging.getLogger("gate"))
    bench.scans = bench.buttons = False
    for _ in range(900):
        bench.send(nan, 0.0)
        bench.send(9.0, 9.0)
        bench.gate.sense("odom", Twist(), bench.now)
        for kind, sentence in bench.run().troubles.items():
            notices.warn(kind, sentence, bench.now)
    said = [record.message for record in caplog.records]
    assert 3 <= len(said) == len(set(said)) <= 6
    assert any("odom" in sentence for sentence in said)


@pytest.mark.slow
def test_ten_times_the_rate_changes_nothing():
    ordinary, hasty = Bench(), Bench()
    for _ in range(200):
        for _ in range(9):
            hasty.send(0.3, 0.2)
        ordinary.wanted = hasty.wanted = (0.3, 0.2)
        assert hasty.run().velocity == ordinary.run().velocity


def test_a_bug_inside_stands_still(monkeypatch):
    bench = Bench()
    bench.run(1.0)
    monkeypatch.setattr("skytether.robot.safety.rules.zones.Zones.allow", lambda *_: 1 / 0)
    decision = bench.run()
    assert decision.velocity == STANDSTILL
    assert "ZeroDivisionError" in decision.troubles["internal"]


wild = st.one_of(st.floats(allow_nan=True, allow_infinity=True), st.sampled_from([0.0, nan, inf, -inf, 1e308, 0.2]))
commands = st.tuples(st.just("command"), wild, wild, st.integers(-3, 9), wild)
scans = st.tuples(st.just("scan"), st.lists(st.floats(allow_nan=True, allow_infinity=True, width=32), max_size=8))
pads = st.tuples(
    st.just("joy"), st.lists(st.floats(allow_nan=True, allow_infinity=True, width=32), max_size=3), st.booleans()
)
buttons = st.tuples(st.just("estop"), st.booleans())
times = st.tuples(st.just("time"), st.one_of(st.just(PERIOD), st.floats(-1, 1), wild))


@settings(max_examples=50, deadline=None)
@given(st.lists(st.one_of(commands, scans, pads, buttons, times), max_size=60))
def test_whatever_comes_in_and_whatever_the_clock_does_the_output_is_a_number_within_the_limits(events):
    gate, now, before = Gate(RULES), 10.0, STANDSTILL
    for kind, *values in events:
        if kind == "command":
            linear, angular, sequence, age = values
            gate.command(Command(Hand.AGENT, linear, angular, 1, sequence, now - age, 0.0, now), now)
        elif kind == "scan":
            gate.sense("scan", replace(laser([]), ranges=np.array(values[0] * 45, dtype=np.float32)), now)
        elif kind == "joy":
            gate.sense(
                "joy",
                Joy(axes=np.array(values[0], dtype=np.float32), buttons=np.array([values[1]], dtype=np.int32)),
                now,
            )
        elif kind == "estop":
            gate.sense("estop", Bool(data=values[0]), now)
        else:
            now += values[0]
        velocity = gate.step(now).velocity
        assert LIMITS.linear_min <= velocity.linear <= LIMITS.linear_max
        assert abs(velocity.angular) <= LIMITS.angular_max
        _assert_no_jump(before, velocity)
        before = velocity
        if not isfinite(now):
            now = 10.0


def _assert_no_jump(before: Velocity, after: Velocity) -> None:
    """No step counts for more than max_step_s, so none changes more than braking does in that time."""
    assert abs(after.linear - before.linear) <= LIMITS.linear_braking * LIMITS.max_step_s + 1e-9
    assert abs(after.angular - before.angular) <= LIMITS.angular_braking * LIMITS.max_step_s + 1e-9


legs = st.lists(st.tuples(st.floats(-0.6, 0.9), st.floats(-1.5, 1.5), st.integers(1, 60)), min_size=1, max_size=10)
things = st.lists(st.tuples(st.floats(0.42, 2.0), st.floats(-math.pi, math.pi)), min_size=1, max_size=12)


@pytest.mark.slow
@settings(max_examples=30, deadline=None)
@given(legs, things)
def test_no_sequence_of_commands_drives_the_robot_into_anything(legs, things):
    """A robot that does what it is told among things that stand still; whatever the agent wants, none is touched."""
    rules = replace(RULES, sources=SourceRules())
    gate = Gate(rules)
    world = np.array([(r * math.cos(a), r * math.sin(a)) for r, a in things])
    world = world[FOOTPRINT.outside(world) > 0.01]
    if not len(world):
        return
    stop_zone = FOOTPRINT.inflated(RULES.zones.stop_m)
    allowed = np.minimum(stop_zone.outside(world), 0.0)  # what is in the stop zone at first gets no deeper into it
    x = y = heading = 0.0
    now, sequence = 0.0, 0
    for linear, angular, ticks in legs:
        for tick in range(ticks):
            now += PERIOD
            sequence += 1
            c, s = math.cos(heading), math.sin(heading)
            relative = (world - (x, y)) @ np.array([[c, -s], [s, c]])
            assert (stop_zone.outside(relative) >= allowed - 0.005).all()
            if tick % 4 == 0:
                gate.sense("scan", _exact(relative), now)
            gate.command(Command(Hand.AGENT, linear, angular, 1, sequence, now, 0.0, now), now)
            velocity = gate.step(now).velocity
            turn = heading + velocity.angular * PERIOD / 2
            x, y = x + velocity.linear * PERIOD * math.cos(turn), y + velocity.linear * PERIOD * math.sin(turn)
            heading += velocity.angular * PERIOD


def _exact(points: Points) -> LaserScan:
    """A scan with a ray of its own for each point: sorted by bearing, with nothing seen in between."""
    bearings = np.degrees(np.arctan2(points[:, 1], points[:, 0])) % 360
    ranges = np.full(36_00, 7.0)
    np.minimum.at(ranges, np.round(bearings * 10).astype(int) % 3600, np.hypot(points[:, 0], points[:, 1]))
    return LaserScan(angle_increment=math.radians(0.1), range_min=0.05, range_max=8.0, ranges=ranges.astype(np.float32))
