"""Lasers that do not see, and the way the robot is then allowed: by the gate's rules, with made-up time."""

import math
from dataclasses import replace
from math import inf, nan
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skytether.messages import Header, LaserScan, Time
from skytether.robot.control.command import Command, Hand
from skytether.robot.control.supervisor import VelocityLimits
from skytether.robot.safety.geometry.footprint import polygon
from skytether.robot.safety.rules.rules import Gate, GateDecision, Rules
from skytether.robot.safety.rules.zones import Zone
from skytether.robot.safety.sensing.coverage import Action, UnseenParams
from skytether.robot.safety.sensing.ranges import Mount
from skytether.robot.safety.sensing.sensing import RangeSensor

BOX = polygon([(0.3, 0.25), (0.3, -0.25), (-0.3, -0.25), (-0.3, 0.25)])
LIMITS = VelocityLimits(linear_max=0.5, linear_min=-0.5, angular_max=1.0)
SLOW = 0.1
PERIOD = LIMITS.period_s


def rules(sensor: RangeSensor | None = None, **changes) -> Rules:
    return replace(Rules(BOX, limits=LIMITS, sensors={"scan": sensor or RangeSensor(Mount())}), **changes)


def scan(ranges, first=-180.0, step=1.0, **fields) -> LaserScan:
    values: dict[str, Any] = {"angle_min": math.radians(first), "angle_increment": math.radians(step)}
    values |= {"range_min": 0.05, "range_max": 8.0, "ranges": np.array(ranges, dtype=np.float32)}
    return LaserScan(**(values | fields))


AROUND = scan([4.0] * 360)


class Drive:
    """A gate that stays where it is: what it sees does not change, however fast it would be."""

    def __init__(self, what: Rules | None = None) -> None:
        self.gate = Gate(what or rules())
        self.now = 100.0
        self.sequence = 0
        for now in (99.6, 99.7, 99.8):  # it begins from a standstill
            self.command((0.0, 0.0), now)

    def command(self, wanted: tuple[float, float], now: float) -> None:
        self.sequence += 1
        self.gate.command(Command(Hand.AGENT, *wanted, 1, self.sequence, now, 0.0, now), now)

    def run(self, message: LaserScan | None, wanted=(0.5, 0.0), seconds: float = 1.0, every: int = 1) -> GateDecision:
        for tick in range(round(seconds / PERIOD)):
            self.now += PERIOD
            if message is not None and tick % every == 0:
                self.gate.sense("scan", message, self.now)
            self.command(wanted, self.now)
            last = self.gate.step(self.now)
        return last


def stamped(message: LaserScan, seconds: float, frame: str = "laser") -> LaserScan:
    whole = int(seconds)
    return replace(message, header=Header(Time(whole, round((seconds - whole) * 1e9)), frame))


def test_a_laser_that_sees_all_around_lets_it_drive():
    for wanted in ((0.5, 0.0), (-0.5, 0.0), (0.0, 1.0), (0.4, 0.6)):
        decision = Drive().run(AROUND, wanted, 0.8)
        assert (decision.velocity, decision.zone, decision.troubles) == (pytest.approx(wanted), Zone.CLEAR, {})


@pytest.mark.parametrize("value", [-inf, -1.0, 0.01, 0.0, nan])
@pytest.mark.parametrize("learned", [True, False])
def test_a_laser_of_nothing_but_one_bad_value_stops_the_robot(value, learned):
    drive = Drive()
    if learned:
        drive.run(AROUND)
    decision = drive.run(scan([value] * 360))
    assert decision.velocity == (0.0, 0.0)
    assert decision.zone in (Zone.UNKNOWN, Zone.STOP)  # what is too close is in the stop zone
    assert "scan: is blind" in decision.troubles["sensor:scan:blind"]


@pytest.mark.parametrize(
    "message",
    [
        scan([4.0], first=180),
        scan([4.0] * 4, first=45, step=90),
        scan([4.0] * 36, step=10),
        scan([4.0] * 90, first=135),
    ],
    ids=["one ray backwards", "four rays", "36 rays", "only behind"],
)
def test_a_laser_that_no_longer_looks_ahead_stops_the_robot_and_never_lets_it_go_fast(message):
    drive = Drive()
    drive.run(AROUND)
    decision = drive.run(message)
    assert (decision.velocity, decision.zone) == ((0.0, 0.0), Zone.UNKNOWN)
    never = Drive().run(message)
    assert never.velocity.linear <= SLOW + 1e-9
    assert never.zone is Zone.UNKNOWN


def test_a_robot_with_a_front_laser_turns_and_reverses_slowly():
    front = scan([4.0] * 181, first=-90)
    what = rules(RangeSensor(Mount(x=0.25)))
    assert Drive(what).run(front).velocity == pytest.approx((0.5, 0.0))
    back = Drive(what).run(front, (-0.5, 0.0))
    assert (back.velocity, back.zone) == (pytest.approx((-0.1, 0.0)), Zone.UNKNOWN)
    assert "no sensor looks" in back.troubles["unseen"]
    assert 0.3 < Drive(what).run(front, (0.0, 1.0), 2.0).velocity.angular < 0.5
    strict = replace(what, unseen=UnseenParams(Action.STOP))
    assert Drive(strict).run(front, (-0.5, 0.0)).velocity == (0.0, 0.0)
    assert Drive(strict).run(front).velocity == pytest.approx((0.5, 0.0))
    bold = replace(what, unseen=UnseenParams(Action.FREE))
    assert Drive(bold).run(front, (-0.5, 0.0)).velocity == pytest.approx((-0.5, 0.0))


def test_without_any_sensor_everything_is_unknown():
    decision = Drive(rules(sensors={})).run(None)
    assert (decision.velocity, decision.zone) == (pytest.approx((0.1, 0.0)), Zone.UNKNOWN)
    bold = rules(sensors={}, unseen=UnseenParams(Action.FREE))
    decision = Drive(bold).run(None)
    assert (decision.velocity, decision.zone) == (pytest.approx((0.5, 0.0)), Zone.UNKNOWN)


def test_what_is_stale_is_unknown_and_not_clear():
    drive = Drive()
    assert drive.run(AROUND).zone is Zone.CLEAR
    assert drive.run(None).zone is Zone.UNKNOWN
    assert drive.run(None, (0.0, 0.0)).zone is Zone.UNKNOWN


def test_too_close_ahead_blocks_the_way_ahead_and_no_other():
    near = [4.0] * 150 + [-inf] * 60 + [4.0] * 150
    for mount in (Mount(), Mount(x=0.25)):
        assert Drive(rules(RangeSensor(mount))).run(scan(near)).velocity == (0.0, 0.0)
        back = Drive(rules(RangeSensor(mount))).run(scan(near), (-0.5, 0.0))
        assert back.velocity == pytest.approx((-0.5, 0.0))


def test_two_old_scans_that_take_turns_are_silence():
    drive = Drive()
    for i in range(50):
        drive.run(stamped(AROUND, 1000 + i * PERIOD), seconds=PERIOD)
    for i in range(100):
        decision = drive.run(stamped(AROUND, 900 + i % 2), seconds=PERIOD)
    assert (decision.velocity, decision.zone) == ((0.0, 0.0), Zone.UNKNOWN)
    assert "older than one before" in decision.troubles["sensor:scan:older"]
    assert "silent for" in decision.troubles["sensor:scan:stale"]


def test_scans_that_come_late_are_as_old_as_they_are():
    drive = Drive()
    for i in range(50):
        drive.run(stamped(AROUND, 1000 + i * PERIOD), seconds=PERIOD)
    for i in range(50, 150):  # 0.4 s later than before, still in order
        late = drive.run(stamped(AROUND, 1000 + max(49 * PERIOD + i * 1e-6, i * PERIOD - 0.4)), seconds=PERIOD).troubles
    assert "0.4 s late" in late["sensor:scan:stale"]


def test_scans_of_another_frame_are_not_used():
    drive = Drive()
    drive.run(stamped(AROUND, 1000.0, "laser"), seconds=PERIOD)
    for i in range(50):
        decision = drive.run(stamped(AROUND, 1001 + i * PERIOD, "laser_rear"), seconds=PERIOD)
    assert decision.velocity == (0.0, 0.0)
    assert "its frame_id is 'laser_rear', not 'laser'" in decision.troubles["sensor:scan:frame"]
    asked = Drive(rules(RangeSensor(Mount(), frame="laser")))
    assert "frame" in str(asked.run(stamped(AROUND, 1000.0, "other"), seconds=PERIOD).troubles)
    # tf of ROS 1 wrote a slash before it.
    assert "frame" not in str(asked.run(stamped(AROUND, 1001.0, "/laser"), seconds=PERIOD).troubles)


def test_a_reset_by_a_person_makes_what_it_sees_then_its_contract():
    drive = Drive()
    drive.run(stamped(AROUND, 1000.0, "laser"), seconds=PERIOD)
    half = scan([4.0] * 181, first=-90)
    for i in range(50):
        drive.run(stamped(half, 1001 + i * PERIOD, "other"), seconds=PERIOD)
    drive.gate.engage("a test")
    assert drive.gate.reset(drive.now) == ""
    for i in range(100, 150):
        decision = drive.run(stamped(half, 1001 + i * PERIOD, "other"), seconds=PERIOD)
    assert not [kind for kind in decision.troubles if kind.startswith("sensor:")]


def wall_ranges(angles, x: float, origin: float, kind: str) -> np.ndarray:
    """Where rays from (origin, 0) meet the wall: across the way ahead or behind at ``x``, or beside at y = ``x``."""
    direction = np.sin(angles) if kind == "beside" else np.cos(angles)
    distance = x if kind == "beside" else x - origin
    with np.errstate(divide="ignore", over="ignore"):
        ranges = distance / direction
    return np.where((ranges > 0) & (ranges < 8), ranges, 7.0)


WAYS = {
    # What is wanted, and where the wall is: within the 0.39 m that the robot needs to stop at 0.5 m/s, and the room.
    "ahead": ((0.5, 0.0), (0.32, 0.75)),
    "behind": ((-0.5, 0.0), (-0.75, -0.32)),
    "curve": ((0.5, 0.4), (0.32, 0.65)),
    "beside": ((0.0, 1.0), (0.26, 0.36)),  # the corners of the box come 0.39 m to the side
}


@st.composite
def broken_scans(draw):
    """A wall in the way of the robot, and a laser that reports it less and less well."""
    way = draw(st.sampled_from(sorted(WAYS)))
    wall = draw(st.floats(*WAYS[way][1]))
    origin = draw(st.sampled_from([-0.2, 0.0, 0.25]))
    step = draw(st.sampled_from([0.25, 0.5, 1.0, 2.0, 5.0, 90.0]))
    first = draw(st.floats(-360, 360))
    rays = draw(st.integers(1, int(360 // step) + 1))
    degrees = first + step * np.arange(rays)
    ranges = wall_ranges(np.radians(degrees), wall, origin, way)
    for _ in range(draw(st.integers(0, 4))):  # masked
        begin, end = sorted((draw(st.integers(0, rays)), draw(st.integers(0, rays))))
        ranges[begin:end] = draw(st.sampled_from([0.0, nan, -1.0, -inf, 0.01]))
    if draw(st.booleans()):  # every second, third ...
        ranges[:: draw(st.integers(1, 7))] = draw(st.sampled_from([0.0, nan, -inf]))
    message = scan(ranges, first, step, angle_max=float(np.radians(degrees[-1])))
    if draw(st.booleans()):  # rays fell out, and the message does not know
        keep = draw(st.lists(st.integers(0, rays - 1), unique=True, max_size=8))
        message = replace(message, ranges=np.delete(message.ranges, keep))
    if draw(st.booleans()):
        turn = draw(st.sampled_from([-1, 1])) * math.tau
        message = replace(message, angle_min=message.angle_min + turn, angle_max=message.angle_max + turn)
    return way, origin, message


@pytest.mark.slow
@settings(max_examples=150, deadline=None)
@given(broken_scans(), st.booleans())
def test_a_wall_in_the_way_is_never_called_clear(broken, learned):
    way, origin, message = broken
    wanted = WAYS[way][0]
    drive = Drive(rules(RangeSensor(Mount(x=origin))))
    if learned:
        drive.run(AROUND, (0.0, 0.0), 2 * PERIOD)
    decision = drive.run(message, wanted, 1.2, every=5)
    assert decision.zone is not Zone.CLEAR
    assert abs(decision.velocity.linear) <= SLOW + 1e-6
    assert abs(decision.velocity.angular) * 0.25 <= SLOW + 1e-6  # of a corner, to the side
