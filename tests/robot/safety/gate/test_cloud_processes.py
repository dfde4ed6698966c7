"""Guard and gate as real processes: a depth camera and a sensor of one fixed distance at ``sensors.sock``."""

from math import inf, nan

import numpy as np
import pytest
from depth_camera import Camera, Face, cloud_of

from skytether.guard.velocity import STANDSTILL
from skytether.lab.safety.robot import PlayedRobot
from skytether.messages import Range

pytestmark = pytest.mark.slow

CAMERA = Camera(width=80, height=60, x=0.2)
DEPTH = {"kind": "points", "x": 0.2, "z": 0.4, "pitch_deg": 15, "max_z_m": 1.0, "range_max": 5.0}


@pytest.fixture
def play(tmp_path):
    robots = []

    def start(safety) -> PlayedRobot:
        robots.append(PlayedRobot(tmp_path, safety))
        return robots[-1]

    yield start
    for robot in robots:
        robot.close()


def stands(robot: PlayedRobot, says: str) -> None:
    robot.wait(lambda: robot.velocity == STANDSTILL, "the robot stands")
    robot.wait(lambda: says in str(robot.ask("status")), f"the gate says '{says}'", 0.1)


def test_a_depth_camera_stops_the_robot_before_what_it_sees_and_when_it_does_not_see(play):
    clear = cloud_of(CAMERA.see(), step=12)
    robot = play({"sensors": {"depth": DEPTH}, "unseen": {"action": "free"}})
    robot.scan = lambda: robot.hardware.send("depth", clear)
    robot.go()
    bar = cloud_of(CAMERA.see([Face(0.38, up=(0.3, 0.5))]), step=12)
    robot.scan = lambda: robot.hardware.send("depth", bar)
    stands(robot, "'zone': 'stop'")
    robot.scan = lambda: robot.hardware.send("depth", clear)
    robot.go()
    empty = cloud_of(np.empty((0, 0, 3)))
    robot.scan = lambda: robot.hardware.send("depth", empty)
    stands(robot, "depth: is blind: an empty cloud")
    robot.scan = lambda: robot.hardware.send("depth", clear)
    robot.go()
    robot.scan = None
    stands(robot, "depth: is stale")


def test_a_sensor_of_one_fixed_distance_says_by_infinities_whether_something_is_there(play):
    """REP 117: -inf is something within that distance, +inf is nothing."""
    robot = play({"sensors": {"scan": {}, "near": {"kind": "sonar", "x": 0.25}}})
    value = inf

    def sense():
        robot.hardware.send("near", Range(field_of_view=0.3, min_range=0.4, max_range=0.4, range=value))
        return robot.clear()

    robot.scan = sense
    robot.go()
    for value, says in ((-inf, "'zone': 'stop'"), (nan, "near: is blind")):
        stands(robot, says)
        value = inf
        robot.go()
