"""How well legs are found and people kept apart in a recording, and what a scan takes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from skytether.lab.leg_bag import LegBag, read_leg_bag

from .navigation import load

Floats = NDArray[np.float64]
Frames = Sequence[Mapping[int, tuple[float, float]]]

_SAME = (0.5, 1.0)
"""Without a truth: a track that begins so near [m], and so soon [s], to where one ended is of the same person."""


class Tracked(Protocol):
    """What `LegsBench` returns, of each scan."""

    @property
    def people(self) -> list[dict[int, tuple[float, float]]]:
        """By number, (x, y) in the laser's frame [m]."""
        ...

    @property
    def hidden(self) -> list[frozenset[int]]:
        """Who of them was not seen."""
        ...

    @property
    def detections(self) -> list[int]:
        """Clusters that looked like legs."""
        ...

    @property
    def wall_ms(self) -> Floats:
        """What it took."""
        ...

    @property
    def cpu_ms(self) -> Floats:
        """Processor time of it."""
        ...


class LegsBench(Protocol):
    """The entry point ``legs``."""

    def __call__(
        self,
        *,
        stamps: Floats,
        ranges: Sequence[NDArray[np.floating]],
        first: float,
        step: float,
        limits: tuple[float, float],
        lasers: Floats,
    ) -> Tracked:
        """Follow all people through a recording; what is given is as in `skytether.lab.leg_bag.LegBag`."""
        ...


def bench_legs(path: Path, topic: str | None = None, angles: tuple[float, float] | None = None) -> dict[str, Any]:
    """Track the people of a recording.

    Args:
        path: See `skytether.lab.leg_bag.read_leg_bag`.
        topic: Of the scans.
        angles: Only who is between these angles of the laser is judged by the truth [deg]; None: between the smallest
            and the largest at which somebody was annotated, for elsewhere nobody looked.

    Raises:
        BagError: The recording cannot be used.
        NavigationBenchError: The service's algorithms are not installed.
    """
    bag = read_leg_bag(path, topic)
    run = cast(LegsBench, load("legs", "follow-in-front"))
    found = run(
        stamps=bag.stamps, ranges=bag.ranges, first=bag.first, step=bag.step, limits=bag.limits, lasers=bag.lasers
    )
    numbers = {number for people in found.people for number in people}
    document = {
        "bag": path.name,
        "topic": bag.topic,
        "scans": len(bag.stamps),
        "seconds": round(float(bag.stamps[-1] - bag.stamps[0]), 3),
        "rays": len(bag.ranges[0]),
        "odometry": bag.moved,
        "detections_per_scan": round(float(np.mean(found.detections)), 3),
        "people_per_scan": round(float(np.mean([len(people) for people in found.people])), 3),
        "tracks": len(numbers),
    }
    document |= _by_tracks(bag, found) if bag.truth is None else _by_truth(found, bag.truth, angles)
    return document | {"ms_per_scan": _times(found.wall_ms), "cpu_ms_per_scan": _times(found.cpu_ms)}


def _times(values: Floats) -> dict[str, float]:
    return {
        "mean": round(float(values.mean()), 3),
        "p99": round(float(np.quantile(values, 0.99)), 3),
        "worst": round(float(values.max()), 3),
    }


def _by_truth(found: Tracked, truth: Frames, angles: tuple[float, float] | None) -> dict[str, Any]:
    from skytether.lab.clear_mot import MATCH, clear_mot

    every = [_angle(place) for people in truth for place in people.values()]
    low, high = angles or ((min(every), max(every)) if every else (-180.0, 180.0))
    score = clear_mot(_within(found.people, low, high), _within(truth, low, high))
    return {
        "judged_by": "truth",
        "angles_deg": [round(low, 1), round(high, 1)],
        "match_m": MATCH,
        "truths": score.truths,
        "mota": None if score.mota is None else round(score.mota, 4),
        "motp_m": None if score.motp_m is None else round(score.motp_m, 4),
        "switches": score.switches,
        "misses": score.misses,
        "false_positives": score.false_positives,
    }


def _angle(place: tuple[float, float]) -> float:
    return math.degrees(math.atan2(place[1], place[0]))


def _within(frames: Frames, low: float, high: float) -> list[dict[int, tuple[float, float]]]:
    return [{n: place for n, place in people.items() if low <= _angle(place) <= high} for people in frames]


def _by_tracks(bag: LegBag, found: Tracked) -> dict[str, Any]:
    """Without a truth: what tracks say of each other. A person who is lost and found counts as a switch."""
    begun: dict[int, int] = {}
    ended: dict[int, int] = {}
    for scan, people in enumerate(found.people):
        for number in people:
            begun.setdefault(number, scan)
            ended[number] = scan
    switches = 0
    for number, scan in begun.items():
        here = _fixed(bag, scan, found.people[scan][number])
        switches += any(
            other != number
            and 0 < bag.stamps[scan] - bag.stamps[last] <= _SAME[1]
            and math.dist(here, _fixed(bag, last, found.people[last][other])) <= _SAME[0]
            for other, last in ended.items()
        )
    return {
        "judged_by": "tracks",
        "switches": switches,
        "misses": sum(len(numbers) for numbers in found.hidden),
    }


def _fixed(bag: LegBag, scan: int, place: tuple[float, float]) -> tuple[float, float]:
    x, y, heading = bag.lasers[scan].tolist()
    cos, sin = math.cos(heading), math.sin(heading)
    return x + cos * place[0] - sin * place[1], y + sin * place[0] + cos * place[1]
