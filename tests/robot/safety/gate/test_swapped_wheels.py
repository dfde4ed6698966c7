"""Wheels of a real ROS 1 graph make their subscription anew while who tells them is killed."""

import os
import time
from contextlib import closing
from types import SimpleNamespace

import pytest
from ros1_nodes import start_rospy

from skytether.lab.safety.robot import PlayedRobot
from skytether.lab.safety.ros1_hardware import Ros1Hardware

pytestmark = [pytest.mark.slow, pytest.mark.ros1]
SWAPS = 6
FAST, SLOW = 0.45, 0.1
WHEELS = """
from geometry_msgs.msg import Twist
def listen(number):
    return rospy.Subscriber("/cmd_vel_safe", Twist, lambda m: say([number, m.linear.x]))
def work():
    number, listening = 0, listen(0)
    for line in sys.stdin:
        listening.unregister()
        number += 1
        listening = listen(number)
threading.Thread(target=work, daemon=True).start()
"""


class Hardware(Ros1Hardware):
    """Others turn the wheels."""

    def __init__(self, folder):
        super().__init__(folder)
        self.section = {"ros1": {**self.section["ros1"], "wheels_nodes": ["/base"]}}


def test_a_subscription_that_is_made_anew_as_its_writer_is_killed_hears_a_standstill_first(tmp_path):
    """By the board they had been told 0.3 m/s, but nobody had told it to that one: 9 of 14."""
    with PlayedRobot(tmp_path, {}, hardware=Hardware) as robot:
        robot.hardware.vanish()
        environment = {**os.environ, "ROS_MASTER_URI": robot.hardware.master, "ROS_IP": "127.0.0.1"}
        graph = SimpleNamespace(environment={**environment, "PYTHONUNBUFFERED": "1", "ROS_LOG_DIR": str(tmp_path)})
        with closing(start_rospy(graph, WHEELS, "base")) as base:
            heard = []

            def drives():
                heard.extend(base.all())
                return bool(heard) and heard[-1][0] == swaps and heard[-1][1] > FAST

            for swaps in range(SWAPS):
                robot.reset()
                robot.start()
                robot.wait(drives, "the wheels to turn")
                robot.kill(robot.pid("writer"))
                time.sleep(0.01 + 0.005 * swaps)
                base.tell("anew")
            swaps = SWAPS
            robot.wait(drives, "the wheels to turn")
    first = {}
    for number, x in heard:
        first.setdefault(number, x)
    assert len(first) == 1 + SWAPS
    assert max(first.values()) <= SLOW, first
