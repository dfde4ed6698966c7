"""What the wheels were really told, where somebody between the agent and them knows. Pure: time is an argument.

A gate limits what the agent wants: it stops the robot, lets a joystick drive, or is slow before an obstacle. An agent
that went on from its own velocity would be far from the wheels' when the gate follows it again.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

from skytether.control.admittance import STANDSTILL, Velocity

from .command import Hand
from .supervisor import Supervised, VelocityLimits


@dataclass(frozen=True, slots=True)
class WheelsFeedback:
    """What the wheels were told last.

    Attributes:
        velocity: WheelsFeedback.
        age_s: How long ago that was known [s].
        stopped: Why the robot stands until a person resets it; empty: it does not.
        hand: Who drives, as the gate says.
        started: A person let the agent go on since it last had to be neutral.
    """

    velocity: Velocity
    age_s: float
    stopped: str = ""
    hand: str = ""
    started: bool = False

    @property
    def nobody(self) -> bool:
        """Nobody may drive: the robot is stopped, or who wants to drive must want a standstill first."""
        return self.hand == Hand.NOBODY

    @property
    def agent(self) -> bool:
        """The agent drives, or may."""
        return self.hand == Hand.AGENT


@runtime_checkable
class TellsBack(Protocol):
    """What a `RobotHardware` may have besides."""

    def told(self, now: float) -> WheelsFeedback | None:
        """What the wheels were told last; None: not known. Never waits.

        Args:
            now: Monotonic seconds.
        """
        ...


@runtime_checkable
class AsksWhy(Protocol):
    """What a `RobotHardware` may have besides."""

    def decided(self, decided: bool) -> None:
        """Whether a standstill that is written from now on is what somebody wants.

        Else it is told because nothing better is known: that is not what somebody has to want before a robot that was
        reset begins to drive.
        """
        ...


def rebase(limits: VelocityLimits, state: Supervised, told: WheelsFeedback) -> Supervised:
    """Go on from what the wheels were told.

    What the agent said in the meantime is under way: its own velocity counts as far as the wheels can have come towards
    it by then.
    """
    if told.stopped:
        return replace(state, velocity=STANDSTILL)
    late = max(0.0, told.age_s) + 2 * limits.period_s
    reach = limits.linear_braking * late, limits.angular_braking * late
    velocity = Velocity(
        *(
            min(max(own, true - far), true + far)
            for own, true, far in zip(state.velocity, told.velocity, reach, strict=True)
        )
    )
    return replace(state, velocity=velocity)
