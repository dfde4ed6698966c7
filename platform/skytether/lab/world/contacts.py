"""The judge: every contact of a robot with a wall, a thing, a person or another robot, as MuJoCo found it. Pure."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

APART_S = 0.5
"""A robot that touches the same again within this time still touches it, s: bodies bounce."""


class Touched(StrEnum):
    """What a robot touched."""

    WALL = "wall"
    THING = "thing"
    PERSON = "person"
    ROBOT = "robot"


@dataclass(frozen=True, slots=True)
class Contact:
    """One contact, from its begin to its end.

    Attributes:
        robot: Number of the robot.
        kind: What it touched.
        name: Which of them, as the plan names it.
        began: Simulated time [s].
        ended: The same; of the last moment so far.
        x: Where it began [m].
        y: Where it began [m].
        force: The strongest [N].
    """

    robot: int
    kind: Touched
    name: str
    began: float
    ended: float
    x: float
    y: float
    force: float


class Judge:
    """Makes contacts of moments of touch."""

    def __init__(self) -> None:
        self.contacts: list[Contact] = []
        """In the order in which they began."""
        self._last: dict[tuple[int, str], int] = {}

    def touch(self, robot: int, kind: Touched, name: str, at: float, x: float, y: float, force: float) -> None:
        """A robot touches something now; fields as those of `Contact`."""
        index = self._last.get((robot, name))
        before = self.contacts[index] if index is not None else None
        if index is not None and before is not None and at - before.ended <= APART_S:
            self.contacts[index] = replace(before, ended=at, force=max(before.force, force))
            return
        self._last[robot, name] = len(self.contacts)
        self.contacts.append(Contact(robot, kind, name, at, at, x, y, force))
