"""A control loop that stood still, with made-up clocks."""

from itertools import count, pairwise
from math import inf, nan

import pytest

from skytether.robot.agent.clocks import read_clocks
from skytether.robot.control.arbiter import LinkRequirements
from skytether.robot.control.command import Source
from skytether.robot.control.control_loop import ControlLoop
from skytether.robot.control.fallback import Admittance
from skytether.robot.control.stall import StallWatch
from skytether.robot.control.supervisor import VelocityLimits
from skytether.robot.session.session import LiveSession

TICK = 0.01
LIMITS = VelocityLimits()
STEP = LIMITS.linear_acceleration * TICK


class Robot:
    """A driver whose two clocks are made up; the cloud sends before each tick."""

    def __init__(self, base, bridge, make_cloud):
        self.base = base
        self.now, self.boot = 100.0, 5000.0
        self.stopped = 0.0
        """How long it is stopped after each begin of a tick, before it writes [s]."""
        self.driver = ControlLoop(base, Admittance(), LIMITS, LinkRequirements(), self.now, None, self.clocks)
        session = LiveSession("1", frozenset({"force"}), "cmd_vel", count(1))
        session.open(lambda port: bridge, ("127.0.0.1", 1))
        self.bridge = bridge
        self.cloud = make_cloud(session)
        self.driver.session = session
        self.speed = 0.2

    def clocks(self):
        return self.now + self.stopped, self.boot + self.stopped

    def tick(self, gap=TICK, slept=0.0):
        self.now += gap
        self.boot += gap + slept
        self.driver.tick(self.now, self.boot)

    def run(self, seconds, command=True):
        for _ in range(round(seconds / TICK)):
            if command:
                self.cloud.send(self.now + TICK, linear=self.speed, angular=0.0)
            self.tick()

    @property
    def told(self):
        return [linear for linear, _ in self.base.written]


@pytest.fixture
def robot(base, bridge, make_cloud):
    robot = Robot(base, bridge, make_cloud)
    robot.run(1.5)
    assert robot.driver.source is Source.CLOUD
    assert robot.told[-1] == pytest.approx(0.2)
    return robot


@pytest.mark.parametrize(("gap", "slept"), [(2.0, 0.0), (0.11, 0.0), (TICK, 3600.0), (TICK, 0.02)])
def test_after_a_gap_the_robot_begins_from_standstill(robot, gap, slept):
    robot.base.push = 0.0
    robot.cloud.send(robot.now + gap, linear=0.2, delay=gap / 2)  # sent during the gap, read after it
    begin = len(robot.told)
    robot.tick(gap, slept)
    assert robot.told[begin:] == [0.0]
    robot.run(0.02)
    assert set(robot.told[begin:]) == {0.0}, "those under way were made before"
    robot.run(1.5)
    assert robot.driver.source is Source.CLOUD
    assert robot.told[-1] == pytest.approx(0.2)
    assert all(after - before <= STEP + 1e-9 for before, after in pairwise([0.0, *robot.told[begin:]]))
    assert robot.driver.status().stalls == 1


@pytest.mark.parametrize("gap", [0.11, 0.3, 2.0])
def test_a_standstill_after_a_gap_is_not_one_that_somebody_wants(robot, gap):
    """Else a robot that was reset would drive because its agent hung for a moment."""
    begin = len(robot.told)
    robot.tick(gap)
    robot.run(3.0)
    assert robot.told[-1] == pytest.approx(0.2)
    stood = [why for told, why in zip(robot.told[begin:], robot.base.why[begin:], strict=True) if not told]
    assert len(stood) > 1
    assert not any(stood)


def test_who_is_stopped_before_writing_writes_a_standstill_that_nobody_wants(robot):
    robot.speed = robot.base.push = 0.0
    robot.run(1.0)
    assert robot.base.why[-1]
    robot.stopped = 1.0
    robot.tick()
    assert robot.told[-1] == 0.0
    assert not robot.base.why[-1]


def test_a_service_that_is_gone_after_the_gap_is_found_out(robot):
    begin = len(robot.told)
    robot.tick(2.0)
    robot.run(0.2, command=False)
    assert robot.driver.source is Source.FALLBACK
    assert robot.told[begin : begin + 10] == [0.0] * 10


def test_a_short_delay_is_no_stall(robot):
    robot.cloud.send(robot.now + 0.09, linear=0.2, angular=0.0)
    robot.tick(0.09)
    assert robot.told[-1] == pytest.approx(0.2)
    assert robot.driver.status().stalls == 0


def test_readings_from_before_the_gap_do_not_drive(robot):
    """They wait in sockets, and come in the first ticks after it."""
    robot.run(1.0, command=False)
    assert robot.driver.source is Source.FALLBACK
    assert robot.told[-1] == pytest.approx(0.1, abs=0.01), "the person pushes"
    begin, published = len(robot.told), len(robot.bridge.published)
    robot.tick(2.0)
    robot.run(0.1, command=False)
    assert set(robot.told[begin:]) == {0.0}
    assert len(robot.bridge.published) == published, "nor are they sent to the service as if they were new"
    robot.run(1.0, command=False)
    assert robot.told[-1] == pytest.approx(0.1, abs=0.01)
    assert all(after - before <= STEP + 1e-9 for before, after in pairwise([0.0, *robot.told[begin:]]))


def test_a_command_that_came_before_the_gap_does_not_come_again_after_it(robot):
    robot.tick(2.0)
    robot.cloud.sequence -= 1
    robot.cloud.send(robot.now + 1.0)
    robot.tick(0.05)
    assert robot.driver.status().objections["sequence"] == 1


def test_who_is_stopped_between_computing_and_writing_writes_a_standstill(robot):
    def stopped():
        robot.now += 2.0
        robot.boot += 2.0
        robot.base.on_read = lambda: None

    robot.base.on_read = stopped
    robot.cloud.send(robot.now + TICK, linear=0.2, angular=0.0)
    robot.tick()
    assert robot.told[-1] == 0.0
    robot.tick()
    assert robot.told[-1] == 0.0
    assert robot.driver.status().stalls == 1


def test_wheels_that_could_not_be_told_are_not_told_at_once_what_they_were_told_before(robot):
    def broken():
        raise OSError("no route to the wheels")

    robot.base.on_write = broken
    robot.run(0.3)
    robot.base.on_write = lambda: None
    begin = len(robot.told)
    robot.run(0.5)
    assert robot.told[begin] <= STEP + 1e-9
    assert robot.told[-1] == pytest.approx(0.2)
    assert robot.driver.status().stalls == 0


def test_the_watch_with_clocks_that_are_not_to_be_trusted():
    watch = StallWatch(0.1)
    assert watch.tick(10.0, 100.0) == 0
    assert watch.tick(10.01, 100.01) == 0
    assert watch.tick(10.02, 100.0) == 0, "interrupted between both clocks"
    assert watch.tick(10.03, 100.03) == 0
    assert watch.tick(nan, nan) == 0
    assert watch.tick(inf, 100.04) == 0
    assert watch.tick(10.05, None) == 0
    assert watch.tick(9.0, None) == 0, "back: the supervisor's clock check brakes"
    assert watch.tick(9.01, 109.01) == pytest.approx(10.01)
    assert watch.tick(9.02, 109.02) == 0, "named once"
    assert watch.tick(9.2, 109.2) == pytest.approx(0.18)


def test_both_clocks_of_this_machine_go_on():
    (now, boot), (later, after) = read_clocks(), read_clocks()
    assert later >= now
    assert after is not None
    assert boot is not None
    assert after >= boot
