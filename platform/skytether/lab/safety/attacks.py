"""What an attack is, and a register of those that there are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from .stage import Promised, Stage


@dataclass(frozen=True, slots=True)
class Attack:
    """One way to make a robot unsafe.

    Attributes:
        name: On the command line and in the table.
        what: In words.
        run: Stages it once, with a robot that drives.
        promised: Picks the time to standstill [s]; None: none is demanded.
        spoils: The robot is of no use for another attack.
        seconds: About how long it takes, for the estimate.
    """

    name: str
    what: str
    run: Callable[[Stage], None]
    promised: Callable[[Promised], float] | None
    spoils: bool
    seconds: float


class Attacks:
    """A register: attacks in the order in which they are staged."""

    def __init__(self) -> None:
        self.all: list[Attack] = []

    def add(
        self,
        name: str,
        what: str,
        run: Callable[[Stage], None],
        promised: Callable[[Promised], float] | None,
        *,
        seconds: float,
        spoils: bool = False,
    ) -> None:
        """Enter one."""
        self.all.append(Attack(name, what, run, promised, spoils, seconds))
