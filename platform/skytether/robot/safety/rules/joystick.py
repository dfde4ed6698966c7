"""The person with the joystick goes before others, while a button is held. Pure: time is an argument.

Letting the button go gives the robot back. A joystick that is lost while it was held, its radio out of reach say, gives
nothing back: the robot stands until the joystick is heard with the button up, and only a press after that drives.

Two signs tell that a joystick is lost. It falls silent. Or it says the same again and again: joy_node's autorepeat goes
on with the last message when the radio is gone (ros-drivers/joystick_drivers#92), and a newer one stamps each repeat
anew (#96), so only the content counts. The hand on a stick is never quite still; see `JoystickParams.max_still_s`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from math import inf, isfinite, nan

from skytether.control.admittance import STANDSTILL, Velocity
from skytether.messages import Joy

RELEASED_S = 0.2
"""How long the button must have been up before a press counts, after a start, a loss or a reset [s]: what waited in a
queue arrives at once, and is no press of now."""
_KEPT = 128
"""Axes and buttons that are compared; a joystick has two dozen."""


@dataclass(frozen=True, slots=True)
class JoystickParams:
    """Which button and axes.

    Attributes:
        deadman: Index of the button to be held.
        linear_axis: Index of the axis for forward.
        angular_axis: Index of the axis for left.
        linear: Velocity at the end of the axis [m/s].
        angular: Rate at the end of the axis [rad/s].
        deadzone: Share of the axis about its middle that is the middle.
        max_age_s: Silence after which a held joystick is lost [s].
        max_still_s: Time without any change of any axis or button after which a joystick that drives is lost [s]; inf:
            it may be still, because its driver ends or falls silent when the joystick is gone (a cable).
    """

    deadman: int = 4
    linear_axis: int = 1
    angular_axis: int = 0
    linear: float = 0.2
    angular: float = 0.4
    deadzone: float = 0.05
    max_age_s: float = 0.3
    max_still_s: float = 1.0


class Grip(StrEnum):
    """What the person does."""

    OFF = "off"
    """Not there, or the button is up."""
    HELD = "held"
    LOST = "lost"
    """It was held when it fell silent, or still."""
    UNSURE = "unsure"
    """The button is down, and was not seen up since the start, a loss or a reset: it need not be a press."""


@dataclass(frozen=True, slots=True)
class Joystick:
    """What is remembered of it.

    Attributes:
        grip: What the person does.
        wanted: Velocity that the axes ask for.
        heard_at: When it last said something that makes sense.
        changed_at: When what it says last changed.
        content: What it said.
        up_since: Since when the button is up; NaN: it is down, or was never heard.
        seen_released: Whether a press counts: the button was seen up since the start, a loss, a reset or `distrust`.
        lost: How it was lost, for people; empty: it is not.
    """

    grip: Grip = Grip.OFF
    wanted: Velocity = STANDSTILL
    heard_at: float = nan
    changed_at: float = nan
    content: tuple[bytes, bytes] = (b"", b"")
    up_since: float = nan
    seen_released: bool = False
    lost: str = ""


def on_message(params: JoystickParams, before: Joystick, message: Joy, now: float) -> tuple[Joystick, str]:
    """Take a message in.

    Returns:
        The new state, and what is wrong with the message (empty: nothing). Without the button a message is as good as
        any; with it, axes that are missing or no numbers leave the joystick held, at a standstill.
    """
    before = expire(params, before, now)  # a silence that this message ends was one all the same
    if params.deadman >= len(message.buttons):
        return before, f"has {len(message.buttons)} buttons, and the deadman is number {params.deadman}"
    content = (message.axes[:_KEPT].tobytes(), message.buttons[:_KEPT].tobytes())
    changed_at = before.changed_at if content == before.content else now
    heard = replace(before, heard_at=now, changed_at=changed_at, content=content, wanted=STANDSTILL)
    if not message.buttons[params.deadman]:
        heard = heard if before.up_since <= now else replace(heard, up_since=now)
        return replace(heard, grip=Grip.OFF, lost=""), ""
    seen_released = before.seen_released or RELEASED_S <= now - before.up_since < inf
    heard = replace(heard, up_since=nan, seen_released=seen_released)
    if before.grip is Grip.LOST or not seen_released:
        return replace(heard, grip=before.grip if before.grip is Grip.LOST else Grip.UNSURE), ""
    wanted, wrong = _wanted(params, message)
    return replace(heard, grip=Grip.HELD, wanted=wanted), wrong


def expire(params: JoystickParams, before: Joystick, now: float) -> Joystick:
    """What has become of it by now. A clock that is no number or went back loses it too."""
    if before.grip in (Grip.HELD, Grip.UNSURE) and not _within(now - before.heard_at, params.max_age_s):
        return _lose(before, "fell silent with the button held")
    moves = before.grip is Grip.HELD and before.wanted != STANDSTILL
    if moves and not _within(now - before.changed_at, params.max_still_s):
        return _lose(
            before, f"says the same for {params.max_still_s:g} s with the button held, as if its radio were gone"
        )
    return before


def distrust(before: Joystick) -> Joystick:
    """No press counts from here on until the button was seen up, as after a reset; what is lost stays lost."""
    grip = Grip.UNSURE if before.grip is Grip.HELD else before.grip
    return replace(before, grip=grip, wanted=STANDSTILL, up_since=nan, seen_released=False)


def _lose(before: Joystick, how: str) -> Joystick:
    return replace(before, grip=Grip.LOST, wanted=STANDSTILL, up_since=nan, seen_released=False, lost=how)


def _within(age: float, most: float) -> bool:
    """A NaN is not; nor is a time from further ahead than two threads may differ."""
    return -min(most, 1.0) <= age <= most


def _wanted(params: JoystickParams, message: Joy) -> tuple[Velocity, str]:
    needed = max(params.linear_axis, params.angular_axis)
    if needed >= len(message.axes):
        return STANDSTILL, f"has {len(message.axes)} axes, and {needed} is used"
    forward, left = float(message.axes[params.linear_axis]), float(message.axes[params.angular_axis])
    if not (isfinite(forward) and isfinite(left)):
        return STANDSTILL, "has an axis that is no number"
    return Velocity(params.linear * _stick(params, forward), params.angular * _stick(params, left)), ""


def _stick(params: JoystickParams, value: float) -> float:
    """The axis from -1 to 1, without the dead zone and without a jump at its end."""
    beyond = min(abs(value), 1.0) - params.deadzone
    if beyond <= 0:
        return 0.0
    return (beyond if value > 0 else -beyond) / (1.0 - params.deadzone)
