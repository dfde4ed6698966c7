"""What came of a trial of `nine_goals`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from .trial.results import Point, Traces, TrialResult


@dataclass(frozen=True, slots=True)
class NineGoalsTraces(Traces):
    """For figures.

    Attributes:
        goals: For each goal the index in ``way`` at which it was reached.
        person: Where the person was who stepped into the way [m].
        plans: Paths that the service planned between the first goal and the second [m].
    """

    goals: tuple[int, ...] = ()
    person: tuple[Point, ...] = ()
    plans: tuple[tuple[Point, ...], ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class NineGoalsResult(TrialResult):
    """What came out. ``completed``: all goals were reached, and nothing was touched.

    Attributes:
        goals: Reached.
        first_leg_m: Of the way, from the first goal to the second, where the person stands in it.
    """

    TRACES: ClassVar[type[Traces]] = NineGoalsTraces

    goals: int
    first_leg_m: float
    traces: NineGoalsTraces = NineGoalsTraces()
