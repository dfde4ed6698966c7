"""One velocity command on its way to the wheels, and who may send one."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from skytether.messages import Twist

UNUSED_AXES = "linear.y, linear.z, angular.x, angular.y"
"""Of a Twist: what wheels that go forward and turn cannot do."""


class Source(StrEnum):
    """Who drives."""

    CLOUD = "cloud"
    """The service, over the bridge."""
    FALLBACK = "fallback"
    """The robot's own controller."""
    STOP = "stop"
    """Nobody: the wheels stand."""


class Hand(StrEnum):
    """Who drives, as the gate says; a further source goes by its name."""

    AGENT = "agent"
    JOYSTICK = "joystick"
    NOBODY = "nobody"


@dataclass(frozen=True, slots=True)
class Command:
    """A velocity that somebody wants, and where it comes from. All times in this robot's monotonic seconds.

    Attributes:
        source: Who wants it; a `Source`, or whoever a gate after the agent tells apart.
        linear: Forward velocity in the robot's base frame [m/s].
        angular: Rate about the vertical axis, positive to the left [rad/s].
        epoch: Counts the handshakes of the bridge; a higher one starts the sequence anew.
        sequence: Counts the commands of one source within one epoch.
        sent_at: When it was made from what was then known; of a fallback's command, when its readings were taken.
        sent_at_error: Bound of the error of ``sent_at`` [s]; inf while the peer's clock is not known.
        received_at: When it reached this robot.
        unused: What it wants along `UNUSED_AXES`, all added up [m/s, rad/s].
        decided: Whether a standstill is what somebody wants; else it is told because nothing better is known.
    """

    source: str
    linear: float
    angular: float
    epoch: int
    sequence: int
    sent_at: float
    sent_at_error: float
    received_at: float
    unused: float = 0.0
    decided: bool = True


def unused_axes(twist: Twist) -> float:
    """What a Twist wants along `UNUSED_AXES`, all added up [m/s, rad/s]; NaN if one is."""
    return abs(twist.linear.y) + abs(twist.linear.z) + abs(twist.angular.x) + abs(twist.angular.y)
