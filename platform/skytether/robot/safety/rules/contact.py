"""Bumpers and cliff sensors: what they feel stops the robot until a person resets it. Pure: time is an argument.

A bumper that was touched, or a floor that is missing, is over in a moment, and what caused it is not. So each is
latched like the emergency stop, and named. Silence stops the robot too, without being latched.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from math import inf, isnan

from skytether.messages import Bool, Message, Range

from .estop import PRESSED_S

_TOLERANCE_S = 0.05
"""How far ahead of now something may have been heard."""


class ContactKind(StrEnum):
    """What it feels."""

    BUMPER = "bumper"
    CLIFF = "cliff"


@dataclass(frozen=True, slots=True)
class ContactParams:
    """One bumper or cliff sensor.

    Attributes:
        kind: What it feels.
        pressed_is: Of a Bool: the value that stops.
        below_m: Of a Range: nearer than this stops [m]; None: no distance is too near.
        above_m: Of a Range: farther than this stops [m]; None: no distance is too far. Without both it sends Bool.
        max_age_s: Silence after which the robot stands [s]; inf: it speaks only when it changes.
    """

    kind: ContactKind = ContactKind.BUMPER
    pressed_is: bool = True
    below_m: float | None = None
    above_m: float | None = None
    max_age_s: float = 0.5

    @property
    def message(self) -> type[Message]:
        """Type of its messages."""
        return Bool if self.below_m is None and self.above_m is None else Range


def feels(params: ContactParams, message: Message) -> bool | None:
    """Whether a message stops the robot; None: it says nothing."""
    if isinstance(message, Bool) and params.message is Bool:
        return bool(message.data) is params.pressed_is
    if not isinstance(message, Range) or params.message is not Range:
        return None
    value = float(message.range)
    if isnan(value) or value == 0:  # no reading; drivers write a zero for "no echo" and for errors alike
        return None
    if params.below_m is None and -inf < value < 0:  # an error of the driver; a near floor is -inf at most (REP 117)
        return None
    near = params.below_m is not None and value < params.below_m
    return near or (params.above_m is not None and value > params.above_m)


class Contacts:
    """All of them.

    Args:
        params: By topic.
    """

    def __init__(self, params: Mapping[str, ContactParams]) -> None:
        self._params = params
        self._heard: dict[str, tuple[bool, float]] = {}
        self._felt_at: dict[str, float] = {}

    def on_message(self, topic: str, message: Message, now: float) -> str:
        """Take a message in.

        Returns:
            Why the robot is to stop until a reset; empty: it is not.
        """
        felt = feels(self._params[topic], message)
        if felt is None:
            return ""
        self._heard[topic] = (felt, now)
        if felt:
            self._felt_at[topic] = now
        return _SAYS[self._params[topic].kind].format(topic) if felt else ""

    def silent(self, now: float) -> Mapping[str, str]:
        """Those that are not heard: a sentence for people, by kind of trouble."""
        found = {}
        for topic, params in self._params.items():
            heard = self._heard.get(topic)
            if heard is None:
                said = "nothing that can be used has come yet"
            elif -_TOLERANCE_S <= now - heard[1] <= params.max_age_s:
                continue
            else:
                said = f"silent for {now - heard[1]:.1f} s"
            found[f"contact:{topic}"] = f"{topic}: the {params.kind} sensor is not heard: {said}; the robot stands"
        return found

    def refuses_reset(self, now: float) -> str:
        """Why a reset must wait; empty: it need not."""
        for topic, (felt, _) in self._heard.items():
            if felt:
                still = "still touched" if self._params[topic].kind is ContactKind.BUMPER else "still without a floor"
                return f"{topic} is {still}; move the robot away by hand first"
        for topic, at in self._felt_at.items():
            if now - at < PRESSED_S:
                return f"{topic} stopped the robot just now"
        return next((f"{sentence}; see that its driver runs" for sentence in self.silent(now).values()), "")


_SAYS = {
    ContactKind.BUMPER: "the bumper {} was touched",
    ContactKind.CLIFF: "the cliff sensor {} sees no floor",
}
