"""The emergency stop: whoever engages it, only a person at the robot releases it. Pure.

The button is a topic that says, again and again, whether it is pressed. Silence of a button that was configured stops
the robot too, but is not latched: a driver that starts a second later than the gate is no emergency.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import isfinite, isinf, isnan, nan

from skytether.guard.protocol import FIRST_ACT

SETTLES_S = 0.1
"""After a time in which the gate stood still, what waited meanwhile comes within this long."""
PRESSED_S = 0.08
"""A reset that comes so soon after a press may have waited since before it, in a gate that hung."""
_TOLERANCE_S = 0.05
"""How far ahead of now something may have been heard."""


@dataclass(frozen=True, slots=True)
class ButtonParams:
    """The emergency stop button.

    Attributes:
        pressed_is: The value of the topic that means pressed; False for a circuit that opens.
        max_age_s: Silence after which the robot stops [s]; inf: the topic speaks only when it changes.
    """

    pressed_is: bool = True
    max_age_s: float = 0.5


@dataclass(frozen=True, slots=True)
class Estop:
    """What is remembered.

    Attributes:
        reason: Why the robot is stopped until somebody resets it; empty: it is not.
        pressed: What the button last said.
        heard_at: When; NaN: never.
        doubted_until: The gate stood still. What it hears until then waited meanwhile and is old: a press counts, and
            that it is not pressed does not; NaN: it did not.
        pressed_at: When it last said that it is pressed; NaN: never.
    """

    reason: str = ""
    pressed: bool = False
    heard_at: float = nan
    doubted_until: float = nan
    pressed_at: float = nan


def engage(before: Estop, reason: str) -> Estop:
    """Stop until reset. The first reason is kept, but for `FIRST_ACT`: what somebody asks for goes before it."""
    return before if before.reason not in ("", FIRST_ACT) else replace(before, reason=reason)


def on_button(params: ButtonParams, before: Estop, value: bool, now: float) -> Estop:
    """Take in what the button says."""
    pressed = value is params.pressed_is
    doubted_until = before.doubted_until if now < before.doubted_until else nan
    pressed_at = now if pressed else before.pressed_at
    heard = replace(before, pressed=pressed, heard_at=now, doubted_until=doubted_until, pressed_at=pressed_at)
    return engage(heard, "the emergency stop button was pressed") if pressed else heard


def doubt(params: ButtonParams, before: Estop, now: float) -> Estop:
    """The gate stood still, and a driver cannot put more into a socket that is full: the button is to be heard anew.

    Its silence counts from now on. One that speaks only when it changes is not waited for.
    """
    if isinf(params.max_age_s):
        return before
    heard_at = now if isfinite(before.heard_at) else before.heard_at
    return replace(before, heard_at=heard_at, doubted_until=now + SETTLES_S)


def doubted(latch: Estop) -> bool:
    """Whether nothing new was heard since the gate stood still."""
    return not isnan(latch.doubted_until)


def reset(params: ButtonParams | None, before: Estop, now: float) -> tuple[Estop, str]:
    """Release it.

    Returns:
        The new state, and why it was refused (empty: it was not).
    """
    if params is not None:
        if before.pressed:
            return before, "the emergency stop button is still pressed; release it first"
        if now - before.pressed_at < PRESSED_S:
            return before, "the emergency stop button was pressed just now"
        if doubted(before) or silent(params, before, now):
            return before, "the emergency stop button is not heard; see that its driver runs"
    return replace(before, reason=""), ""


def silent(params: ButtonParams, latch: Estop, now: float) -> bool:
    """Whether the button has not been heard for too long; NaN and a clock that went back are silence."""
    return not -_TOLERANCE_S <= now - latch.heard_at <= params.max_age_s
