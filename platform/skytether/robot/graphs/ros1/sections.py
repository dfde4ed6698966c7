"""What robot.yaml says of a ROS 1 graph."""

from __future__ import annotations

from pydantic import field_validator, model_validator

from skytether.ros.names import check_name
from skytether.ros.ros1.config import Ros1Link

from ..kind import GateSection, RobotSection


class Ros1Config(RobotSection, Ros1Link):
    """A ROS 1 graph. ``node`` is below the robot's namespace unless it is absolute."""

    params: tuple[str, ...] = ()
    """Parameters that the service's graph gets, by name or namespace: ``/robot_description``."""
    use_sim_time: bool | None = None
    """Whether /clock tells the time; null: as the master's parameter /use_sim_time says."""

    @model_validator(mode="after")
    def _names_are_legal(self) -> Ros1Config:
        self.check_names(1)
        try:
            check_name(self.node)
        except ValueError as error:
            raise ValueError(f"node: {error}") from None
        for i, name in enumerate(self.params):
            try:
                check_name(name)
            except ValueError as error:
                raise ValueError(f"params.{i}: {error}") from None
        return self


class Ros1Way(GateSection, Ros1Link):
    """A robot that is a ROS 1 graph: names are absolute, or in ``namespace``."""

    need_acknowledgements: bool = True
    """Whether the wheels are braked while the computer of somebody who listens to the velocities does not acknowledge
    them; false where others listen over a network that is too bad for that."""

    @field_validator("namespace", "node", "cmd_vel")
    @classmethod
    def _a_name(cls, name: str) -> str:
        return check_name(name)

    @field_validator("wheels_nodes")
    @classmethod
    def _names(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(check_name(name) for name in names)
