"""A robot whose only eye is a depth camera, by the gate's rules, with made-up time."""

import math
from dataclasses import replace

import numpy as np
import pytest
from depth_camera import Camera, Face, cloud_of, optical

from skytether.messages import PointCloud2, Time
from skytether.robot.control.command import Command, Hand
from skytether.robot.control.supervisor import VelocityLimits
from skytether.robot.safety.geometry.footprint import polygon
from skytether.robot.safety.rules.rules import Gate, GateDecision, Rules
from skytether.robot.safety.rules.zones import Zone
from skytether.robot.safety.sensing.clouds import CloudMount
from skytether.robot.safety.sensing.coverage import UnseenParams
from skytether.robot.safety.sensing.sensing import RangeSensor

BOX = polygon([(0.3, 0.25), (0.3, -0.25), (-0.3, -0.25), (-0.3, 0.25)])
LIMITS = VelocityLimits(linear_max=0.5, linear_min=-0.5, angular_max=1.0)
PERIOD = LIMITS.period_s
CAMERA = Camera(near=0.2)
MOUNT = CloudMount(x=CAMERA.x, z=CAMERA.z, pitch=CAMERA.pitch, range_max=4.0, max_z=0.8)
RULES = Rules(BOX, LIMITS, sensors={"depth": RangeSensor(MOUNT)}, unseen=UnseenParams(near_m=0.4))
CLEAR = cloud_of(optical(CAMERA.see()), frame="depth_optical_frame")


def cloud(*faces: Face, camera: Camera = CAMERA) -> PointCloud2:
    return cloud_of(optical(camera.see(faces)), frame="depth_optical_frame")


class Drive:
    """A gate that stays where it is: what it sees does not change, however fast it would be."""

    def __init__(self, what: Rules = RULES) -> None:
        self.gate = Gate(what)
        self.now = 100.0
        self.sequence = 0
        for now in (99.6, 99.7, 99.8):  # it begins from a standstill
            self.command((0.0, 0.0), now)

    def command(self, wanted: tuple[float, float], now: float) -> None:
        self.sequence += 1
        self.gate.command(Command(Hand.AGENT, *wanted, 1, self.sequence, now, 0.0, now), now)

    def run(self, message: PointCloud2 | None, wanted=(0.5, 0.0), seconds: float = 1.0) -> GateDecision:
        for tick in range(round(seconds / PERIOD)):
            self.now += PERIOD
            if message is not None and tick % 4 == 0:  # at 25 Hz
                stamp = Time(int(self.now), round(self.now % 1 * 1e9) % 10**9)
                self.gate.sense("depth", replace(message, header=replace(message.header, stamp=stamp)), self.now)
            self.command(wanted, self.now)
            last = self.gate.step(self.now)
        return last


def test_it_drives_forward_and_only_slowly_where_the_camera_does_not_look():
    decision = Drive().run(CLEAR)
    assert (decision.velocity, decision.zone, decision.troubles) == (pytest.approx((0.5, 0.0)), Zone.CLEAR, {})
    back = Drive().run(CLEAR, (-0.5, 0.0))
    assert (back.velocity, back.zone) == (pytest.approx((-0.1, 0.0)), Zone.UNKNOWN)


def test_without_near_m_it_is_slow_as_the_camera_does_not_see_what_lies_before_its_feet():
    decision = Drive(replace(RULES, unseen=UnseenParams())).run(CLEAR)
    assert decision.velocity.linear == pytest.approx(0.1)
    assert "unseen" in decision.troubles


@pytest.mark.parametrize(
    "face",
    [
        Face(0.55, (-0.03, 0.03), (0.0, 0.1)),
        Face(0.55, (-0.3, 0.3), (0.5, 0.6)),
        Face(0.5, (0.2, 0.3), (0.0, 2.0)),
    ],
    ids=["a foot", "a table", "a post before its corner"],
)
def test_it_is_slow_before_what_a_laser_would_not_see(face):
    assert Drive().run(cloud(face)).velocity.linear <= 0.1 + 1e-9


def test_what_is_higher_than_the_robot_does_not_stop_it():
    assert Drive().run(cloud(Face(0.9, up=(0.85, 2.0)))).velocity.linear == pytest.approx(0.5)


EMPTY = cloud_of(np.empty((0, 0, 3)), frame="depth_optical_frame")
BLIND = {
    "empty": EMPTY,
    "NaN": cloud_of(np.full((120, 160, 3), math.nan), frame="depth_optical_frame"),
    "zeros": cloud_of(np.zeros((120, 160, 3)), frame="depth_optical_frame"),
    "cut off": replace(CLEAR, data=CLEAR.data[:-1]),
    "too near": cloud(Face(0.4, (-0.2, 0.2), (0.0, 0.3)), camera=replace(CAMERA, near=0.25)),
    "half": cloud_of(optical(CAMERA.see()[:, :80]), frame="depth_optical_frame"),
    "silence": None,
    "another frame": replace(CLEAR, header=replace(CLEAR.header, frame_id="other_optical_frame")),
}


@pytest.mark.parametrize("name", BLIND)
def test_a_camera_that_no_longer_sees_stops_the_robot_until_it_does(name):
    drive = Drive()
    drive.run(CLEAR)
    decision = drive.run(BLIND[name])
    assert (decision.velocity, decision.zone) == ((0.0, 0.0), Zone.UNKNOWN)
    assert any(kind.startswith("sensor:depth:") for kind in decision.troubles)
    assert drive.run(CLEAR).velocity == pytest.approx((0.5, 0.0))


@pytest.mark.parametrize("name", ["empty", "NaN", "zeros", "cut off", "silence"])
def test_a_camera_that_never_saw_never_lets_it_drive(name):
    decision = Drive().run(BLIND[name])
    assert (decision.velocity, decision.zone) == ((0.0, 0.0), Zone.UNKNOWN)


def test_a_reset_by_a_person_makes_what_it_sees_then_its_contract():
    drive = Drive()
    drive.run(CLEAR)
    drive.run(BLIND["half"])
    drive.gate.engage("a test")
    assert drive.gate.reset(drive.now) == ""
    assert not [kind for kind in drive.run(BLIND["half"]).troubles if kind.startswith("sensor:")]


def test_it_is_only_as_fast_as_the_floor_is_seen_far():
    fast = replace(RULES, limits=replace(LIMITS, linear_max=1.5))
    assert Drive(fast).run(CLEAR, (1.5, 0.0), 2.0).velocity.linear == pytest.approx(1.5)
    fog = Drive(fast).run(cloud(camera=replace(CAMERA, far=1.0)), (1.5, 0.0), 2.0)
    assert 0.1 < fog.velocity.linear < 1.3
    assert "sight" in fog.troubles
