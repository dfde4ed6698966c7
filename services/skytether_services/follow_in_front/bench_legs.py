"""What ``skytether lab bench legs`` calls, by the entry point ``legs`` of ``skytether.benches``."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .tracker import PeopleTracker

Floats = NDArray[np.float64]

_SHOWN = 0.2
"""Who was not seen for longer than this is not said to be there, s: one scan is missed at 7.5 Hz."""


@dataclass(frozen=True)
class Tracked:
    """What was found in each of n scans.

    Attributes:
        people: By their ids, (x, y) in the laser's frame of that scan [m].
        hidden: Ids of those among them of whom that scan showed nothing.
        detections: Clusters that looked like legs.
        wall_ms: What the scan took.
        cpu_ms: Of it, this thread's processor time.
    """

    people: list[dict[int, tuple[float, float]]]
    hidden: list[frozenset[int]]
    detections: list[int]
    wall_ms: Floats
    cpu_ms: Floats


def track(
    *,
    stamps: Floats,
    ranges: Sequence[NDArray[np.floating]],
    first: float,
    step: float,
    limits: tuple[float, float],
    lasers: Floats,
) -> Tracked:
    """Follow all people through a recording.

    Args:
        stamps: Of the scans [s].
        ranges: Of each scan [m].
        first: Angle of the first ray [rad].
        step: Between neighbouring rays [rad].
        limits: Smallest and largest range that means something [m].
        lasers: Pose of the laser at each scan in a frame that does not move, n by (x [m], y [m], heading [rad]).
    """
    tracker = PeopleTracker()
    found = Tracked([], [], [], np.zeros(len(stamps)), np.zeros(len(stamps)))
    for scan, now in enumerate(stamps.tolist()):
        x, y, heading = lasers[scan].tolist()
        wall, cpu = time.perf_counter(), time.thread_time()
        people = tracker.step(ranges[scan], first, step, limits, (x, y, heading), now)
        found.cpu_ms[scan] = (time.thread_time() - cpu) * 1e3
        found.wall_ms[scan] = (time.perf_counter() - wall) * 1e3
        cos, sin = math.cos(heading), math.sin(heading)
        shown = [person for person in people if now - person.seen_at <= _SHOWN]
        places = {}
        for person in shown:
            px, py = (person.place - (x, y)).tolist()
            places[person.id] = (cos * px + sin * py, cos * py - sin * px)
        found.people.append(places)
        found.hidden.append(frozenset(person.id for person in shown if not person.legs))
        found.detections.append(tracker.legs_seen)
    return found
