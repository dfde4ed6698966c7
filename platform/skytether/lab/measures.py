"""How well a walk along a trail went: time, speed, tracking error, who was in control."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from skytether.robot.command import Source

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


def measure(samples: Sequence[Sample], trail: Trail, *, tolerance: float = 0.1, corridor: float = 0.5) -> Measures:
    """Judge a walk, up to the moment at which it reached the end.

    The tracking error is taken at points of the path 1 cm apart, so that standing still somewhere has no weight.

    Args:
        samples: The walk, in the order of time.
        trail: What was to be followed.
        tolerance: The end counts as reached this far before it, along the trail [m].
        corridor: What is passed further away than this is not passed, to either side [m].

    Raises:
        ValueError: There is no sample.
    """
    if not samples:
        raise ValueError("measure: the walk has no samples; record at least one")
    progress = Progress(trail, corridor=corridor)
    errors: list[float] = []
    source_s: dict[Source, float] = dict.fromkeys(Source, 0.0)
    distance, completed, last = 0.0, False, samples[0]
    for sample in samples:
        step = math.hypot(sample.x - last.x, sample.y - last.y)
        source_s[last.source] += sample.time - last.time
        distance += step
        last = sample
        s = progress.update(sample.x, sample.y)
        if distance >= len(errors) * _SPACING:
            errors.append(progress.offset)
        if s >= trail.length - tolerance:
            completed = True
            break
    time = last.time - samples[0].time
    return Measures(
        completed=completed,
        time_s=time,
        distance_m=distance,
        mean_speed_m_s=distance / time if time > 0 else 0.0,
        kte_m=kinematic_tracking_error(np.array(errors)),
        deviation_max_m=max(map(abs, errors)),
        source_s=source_s,
    )
