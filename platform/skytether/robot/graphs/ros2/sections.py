"""What robot.yaml says of a ROS 2 graph."""

from __future__ import annotations

from pydantic import field_validator, model_validator

from skytether.ros.names import check_name
from skytether.ros.ros2.config import Ros2Graph, Ros2Link, Ros2Velocity

from ..kind import GateSection, RobotSection


class Ros2Config(Ros2Graph, Ros2Velocity, RobotSection):
    """A ROS 2 graph."""

    @model_validator(mode="after")
    def _names_are_legal(self) -> Ros2Config:
        self.check_names(2)
        return self


class Ros2Way(Ros2Link, Ros2Velocity, GateSection):
    """A robot that is a ROS 2 graph. Its nodes are called ``node`` with ``_guard``, ``_gate``, ``_sensors`` after."""

    need_acknowledgements: bool = True
    """Whether the wheels are braked while somebody who listens reliably to the velocities does not acknowledge them;
    false where others listen over a network that is too bad for that. Of ``rclpy``."""

    @field_validator("namespace", "cmd_vel")
    @classmethod
    def _a_name(cls, name: str) -> str:
        return check_name(name, 2)

    @field_validator("wheels_nodes")
    @classmethod
    def _names(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(check_name(name, 2) for name in names)

    @model_validator(mode="after")
    def _names_are_told(self) -> Ros2Way:
        if self.wheels_nodes and self.dialect != "rclpy":
            raise ValueError(
                "wheels_nodes: a graph of Zenoh does not always tell whose a subscription is; leave it out, or join "
                "with dialect: rclpy"
            )
        return self
