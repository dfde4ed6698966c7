"""How a service is tested: no process, no network, made-up time."""

import numpy as np

from skytether.messages import LaserScan, Twist, Vector3
from skytether.testing.service import Harness
from wall_stop.service import WallStop


def scan(*ranges):
    return LaserScan(angle_min=-0.1 * (len(ranges) // 2), angle_increment=0.1, ranges=np.array(ranges))


def test_free_way_is_driven_at_full_speed():
    harness = Harness(WallStop, {"speed": 0.3})
    harness.send("scan", scan(5.0, 5.0, 5.0))
    harness.step()
    assert harness.newest("cmd_vel") == Twist(Vector3(x=0.3))


def test_it_slows_down_and_stops_before_the_wall():
    harness = Harness(WallStop, {"distance": 0.5})
    speeds = []
    for metres in (0.75, 0.5625, 0.5, 0.4):
        harness.send("scan", scan(5.0, metres, 5.0))
        harness.step()
        speeds.append(harness.newest("cmd_vel").linear.x)
    assert speeds == [0.2, 0.0625, 0.0, 0.0]


def test_an_old_scan_moves_nothing():
    harness = Harness(WallStop)
    harness.send("scan", scan(5.0, 5.0, 5.0), age=0.6)
    harness.step()
    assert harness.newest("cmd_vel") is None


def test_a_laser_that_does_not_know_is_a_wall():
    harness = Harness(WallStop)
    for unsure in (scan(5.0, np.nan, 5.0), scan()):
        harness.send("scan", unsure)
        harness.step()
        assert harness.newest("cmd_vel") == Twist()
