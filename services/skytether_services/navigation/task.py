"""What the robot was asked to do: a goal, or a list of goals, once or again and again."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from skytether_services.planar.geometry import Pose

from .status import Code, Trouble

MAX_GOALS = 1000
"""Of one list: more would be a mistake."""


@dataclass(frozen=True)
class Task:
    """Goals, and how far the robot has come with them.

    Attributes:
        goals: In their order, at least one; in the map.
        rounds: How often the list is driven; 0: again and again.
        stop_at_each: Stand at each goal with its heading; false: drive through, and stand at the last.
        index: Of the present goal.
        round: Number of the present round, from 1.
    """

    goals: tuple[Pose, ...]
    rounds: int = 1
    stop_at_each: bool = True
    index: int = 0
    round: int = 1

    @property
    def goal(self) -> Pose:
        """The present one."""
        return self.goals[self.index]

    @property
    def is_last(self) -> bool:
        """Whether nothing comes after the present goal."""
        return self.index == len(self.goals) - 1 and self.round == self.rounds

    @property
    def stops(self) -> bool:
        """Whether the robot is to stand at the present goal, with its heading."""
        return self.stop_at_each or self.is_last

    def following(self) -> Task | None:
        """The task once the present goal is done with; None: there is nothing more to do."""
        if self.is_last:
            return None
        if self.index + 1 < len(self.goals):
            return Task(self.goals, self.rounds, self.stop_at_each, self.index + 1, self.round)
        return Task(self.goals, self.rounds, self.stop_at_each, 0, self.round + 1)

    def until_stop(self, most: int) -> tuple[Pose, ...]:
        """The present goal and those after it, up to the one at which the robot stands; at most so many."""
        found = [self.goal]
        task: Task | None = self
        while task is not None and not task.stops and len(found) < most:
            task = task.following()
            if task is not None:
                found.append(task.goal)
        return tuple(found)


def refusal(goals: Sequence[Pose]) -> Trouble | None:
    """Why a list cannot be a task, whatever the map; None: it can."""
    if not goals:
        return Trouble(Code.NO_GOALS, "The list of goals is empty; send at least one.")
    if len(goals) > MAX_GOALS:
        return Trouble(Code.BAD_GOAL, f"The list has {len(goals)} goals, and may have {MAX_GOALS}.")
    for number, goal in enumerate(goals, 1):
        if not all(math.isfinite(value) for value in goal):
            return Trouble(Code.BAD_GOAL, f"Goal {number} has a coordinate that is not a finite number.")
    return None
