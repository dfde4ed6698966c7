"""How well a walk along a trail went: time, speed, tracking error, who was in control."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from skytether.robot.control.command import Source

from .trail import Progress, Trail

_SPACING = 0.01
"""Distance of the points at which the tracking error is taken, m."""


class Sample(NamedTuple):
    """One moment of a walk: time [s], true position [m], who was in control."""

    time: float
    x: float
    y: float
    source: Source


@dataclass(frozen=True, slots=True)
class Measures:
    """The result.

    Attributes:
        completed: The whole trail was passed in order and its end was reached.
        time_s: From the first sample to reaching the end; to the last sample if it was not reached.
        distance_m: Way covered in that time.
        mean_speed_m_s: That way per time.
        kte_m: Kinematic tracking error (thesis eq. 5.1).
        deviation_max_m: Largest distance from the trail.
        source_s: Seconds under each source's control.
    """

    completed: bool
    time_s: float
    distance_m: float
    mean_speed_m_s: float
    kte_m: float
    deviation_max_m: float
    source_s: dict[Source, float]


def kinematic_tracking_error(errors: NDArray[np.float64]) -> float:
    """Thesis eq. 5.1: sqrt(|mean error|^2 + variance) [m].

    The thesis does not say whether the errors carry the side as a sign. It makes no difference: mean squared plus
    variance is the mean of the squares, whatever the signs.

    Args:
        errors: Distances between points of the performed path and the trail [m], shape (n,), n >= 1.
    """
    return float(np.sqrt(np.abs(np.mean(errors)) ** 2 + np.var(errors)))


class Judge:
    """Judges a walk while it goes on: give it sample after sample, in the order of time.

    The tracking error is taken at points of the path 1 cm apart, so that standing still somewhere has no weight. What
    comes after the end was reached is not judged.
    """

    def __init__(self, trail: Trail, *, tolerance: float = 0.1, corridor: float = 0.5) -> None:
        """Judge by a trail.

        Args:
            trail: What is to be followed.
            tolerance: The end counts as reached this far before it, along the trail [m].
            corridor: What is passed further away than this is not passed, to either side [m].
        """
        self._end = trail.length - tolerance
        self._progress = Progress(trail, corridor=corridor)
        self._errors: list[float] = []
        self._source_s = dict.fromkeys(Source, 0.0)
        self._distance = 0.0
        self._next_error_at = 0.0
        self._began = 0.0
        self._last: Sample | None = None

    @property
    def s(self) -> float:
        """Arc length of the trail reached so far [m]."""
        return self._progress.s

    @property
    def completed(self) -> bool:
        """The whole trail was passed in order and its end was reached."""
        return self.s >= self._end

    def add(self, sample: Sample) -> None:
        """Take the next sample."""
        if self.completed:
            return
        if self._last is None:
            self._began = sample.time
        else:
            self._source_s[self._last.source] += sample.time - self._last.time
            self._distance += math.hypot(sample.x - self._last.x, sample.y - self._last.y)
        self._last = sample
        self._progress.update(sample.x, sample.y)
        if self._distance >= self._next_error_at:
            self._errors.append(self._progress.offset)
            self._next_error_at = (self._distance // _SPACING + 1) * _SPACING

    def result(self) -> Measures:
        """The measures so far.

        Raises:
            ValueError: There was no sample.
        """
        if self._last is None:
            raise ValueError("the walk has no samples; give at least one")
        time = self._last.time - self._began
        return Measures(
            completed=self.completed,
            time_s=time,
            distance_m=self._distance,
            mean_speed_m_s=self._distance / time if time > 0 else 0.0,
            kte_m=kinematic_tracking_error(np.array(self._errors)),
            deviation_max_m=max(map(abs, self._errors)),
            source_s=dict(self._source_s),
        )


def measure(samples: Iterable[Sample], trail: Trail) -> Measures:
    """Judge a whole walk.

    Raises:
        ValueError: There is no sample.
    """
    judge = Judge(trail)
    for sample in samples:
        judge.add(sample)
    return judge.result()
