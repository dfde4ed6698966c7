"""The gate's way to the robot's own hardware: readings in, velocities out. Nothing behind these waits."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple, Protocol

from skytether.guard import teller
from skytether.messages import Message


class WheelsTiming(NamedTuple):
    """How long the wheels may be told nothing by one, until another does.

    Attributes:
        guard_s: The guard brakes when the gate has said nothing for this long, and the gate when the guard has not.
        fresh_s: How old a velocity may get that another thread or process sends for whoever tells the wheels. It is no
            older when the other one speaks, if who tells them and who sends it stand still together.
        stuck_s: After how long who sends it counts as standing still.
        brakes_s: Within this time the gate has stopped wheels that nobody else tells anything.
    """

    guard_s: float
    fresh_s: float
    stuck_s: float
    brakes_s: float


class Wheels(teller.Wheels, Protocol):
    """Where velocities go, and the enable signal where that is a topic."""

    def enable(self, level: bool) -> None:
        """Publish a level of the enable signal.

        Raises:
            OSError: It did not get there.
        """
        ...

    def close(self) -> None:
        """Let go of it."""
        ...


class Sensors(Protocol):
    """Where readings come from."""

    def stops(self) -> Iterable[tuple[str, Message]]:
        """What buttons, bumpers and cliff sensors said since the last call: the last press of each, and the last word.

        Taken first at each turn. Returns at once and never raises.
        """
        ...

    def read(self) -> Iterable[tuple[str, Message]]:
        """What else came since the last call, by topic, oldest first. Returns at once and never raises."""
        ...

    def close(self) -> None:
        """Let go of it."""
        ...


class Display(Protocol):
    """Where something is published for people."""

    def publish(self, message: Message) -> None:
        """Publish it. Returns at once."""
        ...

    def close(self) -> None:
        """Let go of it."""
        ...
