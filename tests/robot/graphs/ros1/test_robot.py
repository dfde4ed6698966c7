"""A robot that is a ROS 1 graph: what it hands to its node; on a real graph see tests/ros/ros1."""

from typing import Any

import pytest

from skytether.guard.clock import now
from skytether.messages import Twist, Vector3, decode
from skytether.robot.graphs.ros1.robot import Ros1Robot, Ros1RobotConfig


class Told:
    """A node and its only publication."""

    name = "/skytether"

    def __init__(self) -> None:
        self.frames: list[tuple[float, float]] = []
        """Velocities, and until when each may be sent."""

    def advertise(self, *_: Any, **__: Any) -> "Told":
        return self

    def publish(self, payload: bytes, until: float) -> None:
        self.frames.append((decode(Twist, payload, "ros1").linear.x, until))


def test_the_wheels_get_no_velocity_that_waited_for_the_nodes_thread_for_too_long() -> None:
    """An agent without a gate that was frozen right after `write` would tell the standing robot to drive."""
    node = Told()
    robot = Ros1Robot(Ros1RobotConfig("walker", "trail", fresh_s=0.25), node)  # type: ignore[arg-type]
    before = now()
    robot.base.write(Twist(linear=Vector3(x=0.5)))
    ((velocity, until),) = node.frames
    assert velocity == 0.5
    assert before + 0.25 <= until <= now() + 0.25
    assert Ros1RobotConfig("walker", "trail").fresh_s == pytest.approx(0.1)
