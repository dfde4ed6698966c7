"""The parameters of the nodes, as ROS 2 describes them. All are read at the start: a robot is not changed under way."""

from __future__ import annotations

import os
from typing import Any, NamedTuple

from rcl_interfaces.msg import IntegerRange, ParameterDescriptor
from rclpy.node import Node

AS_IN_FILE = -1
"""Value of a number that stays as robot.yaml has it."""


class Declared(NamedTuple):
    """One parameter.

    Attributes:
        name: In the node.
        default: Its type is the parameter's.
        description: For `ros2 param describe`.
        range: Least and greatest value of a number.
    """

    name: str
    default: Any
    description: str
    range: tuple[int, int] | None = None

    def on(self, node: Node) -> Any:
        """Declare it on a node; returns its value."""
        descriptor = ParameterDescriptor(description=self.description, read_only=True)
        if self.range is not None:
            least, greatest = self.range
            descriptor.integer_range = [IntegerRange(from_value=least, to_value=greatest, step=1)]
        return node.declare_parameter(self.name, self.default, descriptor).value


def of_program() -> list[Declared]:
    """What every node has."""
    return [
        Declared(
            "config",
            os.environ.get("SKYTETHER_ROBOT", "/etc/skytether/robot.yaml"),
            "robot.yaml of this robot; without it the environment's SKYTETHER_ROBOT, or /etc/skytether/robot.yaml",
        ),
        Declared(
            "program",
            os.environ.get("SKYTETHER", "skytether"),
            "The program skytether, by path or name; without it the environment's SKYTETHER, or the one on the path",
        ),
    ]


def of_robot() -> list[Declared]:
    """What the robot's agent is given in place of what robot.yaml says."""
    return [
        Declared("service", "", "Service to ask for, in place of robot.yaml's; empty: robot.yaml's"),
        Declared("params", "", "Parameters of the service, as YAML: {max_speed: 0.4}; empty: robot.yaml's"),
        Declared("topics", [""], "Topics for a service that takes any, such as recorder; empty: robot.yaml's"),
        Declared(
            "status_port",
            AS_IN_FILE,
            "Port of /status and /metrics on loopback; 0: any free one; -1: robot.yaml's",
            (AS_IN_FILE, 65_535),
        ),
    ]


def words(values: dict[str, Any]) -> list[str]:
    """What is given of `of_robot`, as `skytether robot run` takes it."""
    given = {name: values.get(name, "") for name in ("service", "params")}
    given["topics"] = "[" + ", ".join(topic for topic in values.get("topics", ()) if topic) + "]"
    given["status_port"] = str(values.get("status_port", AS_IN_FILE))
    return [f"_{name}:={value}" for name, value in given.items() if value not in ("", "[]", str(AS_IN_FILE))]
