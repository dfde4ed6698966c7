"""Who drives: nobody, a person with the joystick, or the agent. Pure: time is an argument.

How fast is not asked here: that is the supervisor's, and the zones'.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

from skytether.messages import Bool, Joy, Message
from skytether.robot.command import Command
from skytether.robot.supervisor import Limits

from . import joystick, latch
from .joystick import Grip, Joystick, JoystickParams
from .latch import ButtonParams, Latch


class Hand(StrEnum):
    """Who drives."""

    AGENT = "agent"
    JOYSTICK = "joystick"
    NOBODY = "nobody"


@dataclass(frozen=True, slots=True)
class SourceRules:
    """Who may drive, and who may stop the robot.

    Attributes:
        joystick: None: there is none.
        joystick_topic: Its topic.
        button: The emergency stop button; None: there is none.
        button_topic: Its topic.
    """

    joystick: JoystickParams | None = None
    joystick_topic: str = "joy"
    button: ButtonParams | None = None
    button_topic: str = "estop"


class Sources:
    """Takes in what people say, and tells at each step who drives.

    Args:
        rules: What is configured.
        limits: The supervisor's; `max_gap_s` is the age at which a command of the agent ends.
        stopped: Why the robot is to stand until somebody resets it; empty: it is not.
    """

    def __init__(self, rules: SourceRules, limits: Limits, stopped: str = "") -> None:
        self._rules = rules
        self._limits = limits
        self._joystick = Joystick()
        self._latch = Latch(reason=stopped)
        self._count = 0

    @property
    def stopped(self) -> str:
        """Why the robot stands until somebody resets it; empty: it does not."""
        return self._latch.reason

    def engage(self, reason: str) -> None:
        """Emergency stop, until `reset`."""
        self._latch = latch.engage(self._latch, reason)

    def reset(self, now: float) -> str:
        """End the emergency stop.

        Returns:
            Why it was refused; empty: it was not.
        """
        self._latch, refused = latch.reset(self._rules.button, self._latch, now)
        if not refused:
            self._joystick = Joystick()
        return refused

    def expects(self, topic: str, message: Message) -> bool:
        """Whether `hear` is for this message."""
        rules = self._rules
        return (rules.joystick is not None and topic == rules.joystick_topic and isinstance(message, Joy)) or (
            rules.button is not None and topic == rules.button_topic and isinstance(message, Bool)
        )

    def hear(self, topic: str, message: Message, now: float) -> tuple[Command | None, str]:
        """Take a message in. Never raises for what it holds.

        Returns:
            The command that it is, if it is one, and what is wrong with it (empty: nothing).
        """
        rules = self._rules
        if rules.button is not None and topic == rules.button_topic and isinstance(message, Bool):
            self._latch = latch.hear(rules.button, self._latch, bool(message.data), now)
            return None, ""
        if rules.joystick is None or not isinstance(message, Joy):
            return None, ""
        self._joystick, wrong = joystick.hear(rules.joystick, self._joystick, message, now)
        if self._joystick.grip is not Grip.HELD:
            return None, wrong
        self._count += 1
        linear, angular = self._joystick.wanted
        return Command(Hand.JOYSTICK, linear, angular, 0, self._count, now, 0.0, now), wrong

    def look(self, now: float, troubles: dict[str, str]) -> Hand:
        """Who drives now.

        Args:
            now: Monotonic seconds.
            troubles: Gets a sentence for people about each thing that stands in the way.
        """
        rules = self._rules
        if rules.joystick is not None:
            self._joystick = joystick.look(rules.joystick, self._joystick, now)
        if self._latch.reason:
            troubles["stopped"] = f"emergency stop: {self._latch.reason}; `skytether robot reset` ends it"
            return Hand.NOBODY
        if rules.button is not None and latch.silent(rules.button, self._latch, now):
            troubles["button"] = f"{rules.button_topic}: the emergency stop button is not heard; the robot stands"
            return Hand.NOBODY
        if self._joystick.grip is Grip.LOST:
            troubles["joystick"] = (
                f"{rules.joystick_topic}: fell silent with the button held; the robot stands until it is heard with the"
                " button up, or until `skytether robot reset`"
            )
            return Hand.NOBODY
        return Hand.JOYSTICK if self._joystick.grip is Grip.HELD else Hand.AGENT

    def limits(self, hand: Hand) -> Limits:
        """The supervisor's limits while that one drives."""
        params = self._rules.joystick
        if hand is Hand.JOYSTICK and params is not None:
            return replace(self._limits, max_gap_s=params.max_age_s)
        return self._limits
