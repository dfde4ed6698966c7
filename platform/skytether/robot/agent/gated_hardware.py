"""A robot whose wheels are behind a gate, as the agent sees it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from skytether.control.admittance import Velocity
from skytether.messages import Message, Twist
from skytether.robot.control.command import UNUSED_AXES, unused_axes
from skytether.robot.control.control_loop import RobotHardware
from skytether.robot.control.wheels_feedback import WheelsFeedback

from ..safety.client import GateLink

_FRESH_S = 0.2
"""The gate answers each command, within a turn of its loop: older answers are of a gate that is gone or frozen."""


class GatedHardware:
    """A `RobotHardware` that reads as another does, and writes to the gate.

    Args:
        hardware: For the readings; its ``write`` is never called.
        link: To the gate.
    """

    def __init__(self, hardware: RobotHardware, link: GateLink) -> None:
        self.topics: Mapping[str, type[Message]] = hardware.topics
        self._hardware = hardware
        self._link = link
        self._decided = True

    def read(self, now: float) -> Iterable[tuple[str, Message]]:
        """RobotHardware: the other's readings."""
        return self._hardware.read(now)

    def write(self, twist: Twist) -> None:
        """RobotHardware: ask the gate.

        Raises:
            OSError: There is no gate; tried again at the next tick.
            ValueError: It wants to move along an axis that the wheels do not have.
        """
        if unused_axes(twist):
            raise ValueError(
                f"a velocity along {UNUSED_AXES} cannot be asked of the gate: the wheels do not have these"
            )
        self._link.send(Velocity(twist.linear.x, twist.angular.z), self._decided)

    def decided(self, decided: bool) -> None:
        """Whether a standstill that is written from now on is what somebody wants."""
        self._decided = decided

    def told(self, _now: float) -> WheelsFeedback | None:
        """What the gate told the wheels last, if it has answered lately."""
        state = self._link.state()
        if state is None:
            return None
        age = self._link.now() - state.at
        if not 0 <= age <= _FRESH_S:
            return None
        return WheelsFeedback(state.told, age, state.stopped, state.hand, state.started)
