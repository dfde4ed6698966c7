"""The person with the joystick goes before everybody else, while a button is held. Pure: time is an argument.

Letting the button go gives the robot back. A joystick that falls silent while it was held, its radio out of reach say,
gives nothing back: the robot stands until the joystick is heard again with the button up, or a person resets the gate.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from math import isfinite

from skytether.control.admittance import STANDSTILL, Velocity
from skytether.messages import Joy


@dataclass(frozen=True, slots=True)
class JoystickParams:
    """Which button and axes.

    Attributes:
        deadman: Index of the button to be held.
        linear_axis: Index of the axis for forward.
        angular_axis: Index of the axis for left.
        linear: Velocity at the end of the axis [m/s].
        angular: Rate at the end of the axis [rad/s].
        max_age_s: Silence after which a held joystick is lost [s].
    """

    deadman: int = 4
    linear_axis: int = 1
    angular_axis: int = 0
    linear: float = 0.2
    angular: float = 0.4
    max_age_s: float = 0.3


class Grip(StrEnum):
    """What the person does."""

    OFF = "off"
    """Not there, or the button is up."""
    HELD = "held"
    LOST = "lost"
    """It was held when it fell silent."""


@dataclass(frozen=True, slots=True)
class Joystick:
    """What is remembered of it."""

    grip: Grip = Grip.OFF
    wanted: Velocity = STANDSTILL
    heard_at: float = 0.0


def hear(params: JoystickParams, before: Joystick, message: Joy, now: float) -> tuple[Joystick, str]:
    """Take a message in.

    Returns:
        The new state, and what is wrong with the message (empty: nothing). Without the button a message is as good as
        any; with it, axes that are missing or no numbers leave the joystick held, at a standstill.
    """
    if params.deadman >= len(message.buttons):
        return before, f"has {len(message.buttons)} buttons, and the deadman is number {params.deadman}"
    if not message.buttons[params.deadman]:
        return Joystick(Grip.OFF, STANDSTILL, now), ""
    needed = max(params.linear_axis, params.angular_axis)
    if needed >= len(message.axes):
        return Joystick(Grip.HELD, STANDSTILL, now), f"has {len(message.axes)} axes, and {needed} is used"
    forward, left = float(message.axes[params.linear_axis]), float(message.axes[params.angular_axis])
    if not (isfinite(forward) and isfinite(left)):
        return Joystick(Grip.HELD, STANDSTILL, now), "has an axis that is no number"
    wanted = Velocity(params.linear * _unit(forward), params.angular * _unit(left))
    return Joystick(Grip.HELD, wanted, now), ""


def look(params: JoystickParams, before: Joystick, now: float) -> Joystick:
    """What has become of it by now. A clock that is no number or went back loses it too."""
    if before.grip is Grip.HELD and not -params.max_age_s <= now - before.heard_at <= params.max_age_s:
        return Joystick(Grip.LOST, STANDSTILL, before.heard_at)
    return before


def _unit(value: float) -> float:
    return min(max(value, -1.0), 1.0)
