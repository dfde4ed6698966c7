"""What an attack is, and a register of those that there are."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .checker import Finding
from .robot import PlayedRobot
from .stage import Stage

MakeRobot = Callable[[Path, Mapping[str, Any]], AbstractContextManager[PlayedRobot]]
"""Given a folder, and keys of the section ``safety`` that are to be others."""


@dataclass(frozen=True, slots=True)
class Attack:
    """One way to make a robot unsafe.

    Attributes:
        name: On the command line and in the table.
        what: In words.
        run: Stages it once, with a robot that drives.
        rehearse: Instead of that: stages it without processes.
        spoils: The robot is of no use for another attack.
        seconds: About how long it takes, for the estimate.
        robot: Makes the robot that it needs; None: the usual one.
    """

    name: str
    what: str
    run: Callable[[Stage], None] | None
    spoils: bool
    seconds: float
    robot: MakeRobot | None = None
    rehearse: Callable[[], Finding] | None = None


_REHEARSAL_S = 0.5


class Attacks:
    """A register: attacks in the order in which they are staged."""

    def __init__(self) -> None:
        self.all: list[Attack] = []

    def add(
        self,
        name: str,
        what: str,
        run: Callable[[Stage], None],
        *,
        seconds: float,
        spoils: bool = False,
        robot: MakeRobot | None = None,
    ) -> None:
        """Enter one."""
        self.all.append(Attack(name, what, run, spoils, seconds, robot))

    def add_rehearsal(self, name: str, what: str, rehearse: Callable[[], Finding]) -> None:
        """Enter one that needs no processes."""
        self.all.append(Attack(name, what, None, False, _REHEARSAL_S, rehearse=rehearse))
