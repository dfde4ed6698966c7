"""A robot whose wheels are behind a gate, as the agent sees it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from skytether.control.admittance import Velocity
from skytether.messages import Message, Twist
from skytether.robot.control.command import UNUSED_AXES, unused_axes
from skytether.robot.control.control_loop import Base
from skytether.robot.control.wheels_feedback import Told

from ..safety.client import GateLink

_FRESH_S = 0.2
"""The gate answers each command, within a turn of its loop: older answers are of a gate that is gone or frozen."""


class GatedBase:
    """A `Base` that reads as another does, and writes to the gate.

    Args:
        base: For the readings; its ``write`` is never called.
        link: To the gate.
    """

    def __init__(self, base: Base, link: GateLink) -> None:
        self.topics: Mapping[str, type[Message]] = base.topics
        self._base = base
        self._link = link
        self._decided = True

    def read(self, now: float) -> Iterable[tuple[str, Message]]:
        """Base: the other's readings."""
        return self._base.read(now)

    def write(self, twist: Twist) -> None:
        """Base: ask the gate.

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

    def told(self, _now: float) -> Told | None:
        """What the gate told the wheels last, if it has answered lately."""
        state = self._link.state()
        if state is None:
            return None
        age = self._link.now() - state.at
        if not 0 <= age <= _FRESH_S:
            return None
        return Told(state.told, age, state.stopped, state.hand, state.started)
