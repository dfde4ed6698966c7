"""The benchmark of localisation on a recorded log: ``skytether lab bench localisation LOG``.

The map is built from the first part of the log, at its corrected poses; the robot is localised in the rest, by odometry
to which noise was added. The corrected poses there are the truth.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skytether_services.navigation.likelihood_field import LikelihoodField, likelihood_field
from skytether_services.navigation.localisation import Estimate, Localisation
from skytether_services.navigation.log_odds import occupancy
from skytether_services.navigation.poses import between, wrap

Array = NDArray[np.float64]

MAP_SHARE = 0.6
"""Of the log, from its begin, that the map is built from."""
NOISE = (0.1, 0.1)
"""Added to odometry: standard deviations of each step, per metre of it and per radian of it."""
LOST_M = 1.0
"""Tracking that is further off than this at its end, or for more than 10 s on end, was lost."""
LOST_S = 10.0
RIGHT_M, RIGHT_RAD = 0.5, math.radians(10)
"""A pose as near as this is right, where the robot was found."""
FOUND_S, FOUND_AGAIN_S = 10.0, 15.0
"""Of driving, within which it is to be found; and after it was carried away."""
IN_MAP = 0.5
"""Where less of the way is on floor that the map shows, nothing can be expected to find the robot: it counts apart."""
WARM_UP = 20
"""First updates, which compile and fill caches; they are not among the update times of the first seed."""


@dataclass(frozen=True)
class Drive:
    """What localisation gets of a log, and the truth.

    Attributes:
        stamps: n [s].
        points: For each scan m by 2 [m].
        truth: n by 3.
        steps: n by 3: motion from the scan before, in the robot's frame; with noise.
    """

    stamps: Array
    points: list[Array]
    truth: Array
    steps: Array


def run(
    *,
    stamps: Array,
    ranges: NDArray[np.float32],
    angles: Array,
    max_range: float,
    laser: Array,
    odometry: Array,
    seeds: Sequence[int],
    progress: Callable[[str], None],
    starts: int = 0,
    kidnaps: int = 0,
) -> dict[str, Any]:
    """Measure localisation; see ``skytether.lab.bench.navigation.LocalisationBench`` for the arguments.

    Args:
        stamps: Of the scans [s].
        ranges: Of the scans [m].
        angles: Of the rays, evenly apart [rad].
        max_range: From here on nothing was seen [m].
        laser: Corrected poses, the truth.
        odometry: Not used: in corrected logs it often repeats the corrected poses. Noise is added to their increments.
        seeds: One tracking run for each.
        progress: Told now and then how far it is.
        starts: So many times the robot is to be found without a first pose.
        kidnaps: So many times it is carried away.

    Raises:
        ValueError: The log is too short.
    """
    del odometry
    split = int(MAP_SHARE * len(stamps))
    if split < 20 or len(stamps) - split < 20:
        raise ValueError(f"the log has {len(stamps)} scans; 50 are needed to build a map and to drive through it")
    progress(f"building the map from {split} scans")
    field = likelihood_field(occupancy(ranges[:split], angles, max_range, laser[:split]))
    rest = [scan_points(scan, angles, max_range) for scan in ranges[split:]]

    def drive(seed: int) -> Drive:
        return Drive(stamps[split:], rest, laser[split:], noisy_steps(laser[split:], np.random.default_rng(seed)))

    result = _tracking(field, drive, seeds, progress)
    if starts:
        result |= _global(field, drive, starts, seeds[0], progress)
    if kidnaps:
        result |= _kidnapped(field, drive, kidnaps, seeds[0], progress)
    return result


def scan_points(scan: NDArray[np.float32], angles: Array, max_range: float) -> Array:
    """Ends of the beams that met something, in the laser's frame, n by 2 [m]."""
    met = (scan > 0.05) & (scan < max_range)
    return np.column_stack((scan[met] * np.cos(angles[met]), scan[met] * np.sin(angles[met]))).astype(np.float64)


def noisy_steps(poses: Array, random: np.random.Generator) -> Array:
    """Motions from pose to pose, in the frame of the first, each with an error in proportion to it."""
    steps = np.vstack((np.zeros((1, 3)), between(poses[:-1], poses[1:])))
    distance, turn = np.hypot(steps[:, 0], steps[:, 1]), np.abs(steps[:, 2])
    errors = random.standard_normal((len(steps), 2))
    # The error of the distance lies along the motion.
    scale = 1 + NOISE[0] * errors[:, 0]
    return np.column_stack(
        (steps[:, :2] * scale[:, None] * (distance > 0)[:, None], steps[:, 2] + NOISE[1] * errors[:, 1] * turn)
    )


def errors_of(pose: Array, truth: Array) -> tuple[float, float]:
    """Distance [m] and difference in heading [rad] between poses."""
    heading = float(wrap(np.array(pose[2] - truth[2])))
    return math.hypot(pose[0] - truth[0], pose[1] - truth[1]), abs(heading)


def is_right(estimate: Estimate, truth: Array) -> bool:
    """Whether an estimate is near enough to call the robot found."""
    off, turned = errors_of(estimate.pose, truth)
    return off <= RIGHT_M and turned <= RIGHT_RAD


def _tracking(
    field: LikelihoodField, drive: Callable[[int], Drive], seeds: Sequence[int], progress: Callable[[str], None]
) -> dict[str, Any]:
    positions: list[float] = []
    headings: list[float] = []
    times: list[float] = []
    busy: list[float] = []
    lost = 0
    for number, seed in enumerate(seeds):
        data = drive(seed)
        localisation = Localisation(field, np.random.default_rng((seed, 1)))
        localisation.place(data.truth[0], np.diag([0.04, 0.04, 0.01]))
        off_since: float | None = None
        was_lost = False
        for index, points in enumerate(data.points):
            began, busy_before = time.perf_counter(), time.thread_time()
            estimate = localisation.update(data.steps[index], points)
            if number or index >= WARM_UP:
                times.append(time.perf_counter() - began)
                busy.append(time.thread_time() - busy_before)
            off, turned = errors_of(estimate.pose, data.truth[index])
            positions.append(off)
            headings.append(turned)
            if off <= LOST_M:
                off_since = None
            elif off_since is None:
                off_since = data.stamps[index]
            was_lost |= off_since is not None and data.stamps[index] - off_since > LOST_S
        lost += was_lost or off_since is not None
        progress(f"tracked with seed {seed}: mean {np.mean(positions[-len(data.points) :]):.3f} m")
    return {
        "position_mean_m": round(float(np.mean(positions)), 4),
        "position_p95_m": round(float(np.percentile(positions, 95)), 4),
        "heading_mean_deg": round(math.degrees(float(np.mean(headings))), 3),
        "lost": int(lost),
        "seeds": len(seeds),
        "update_p99_ms": round(1000 * float(np.percentile(times, 99)), 2),
        "update_cpu_p99_ms": round(1000 * float(np.percentile(busy, 99)), 2),
    }


def driving_seconds(data: Drive) -> Array:
    """Seconds of driving until each scan: pauses without motion do not count."""
    moved = (np.hypot(data.steps[:, 0], data.steps[:, 1]) > 0.005) | (np.abs(data.steps[:, 2]) > 0.005)
    gaps = np.diff(data.stamps, prepend=data.stamps[0])
    return np.cumsum(np.where(moved, gaps, 0.0))


def _on_floor(field: LikelihoodField, poses: Array) -> NDArray[np.bool_]:
    """Whether each pose is where the map has seen the floor."""
    return np.array([0 <= field.grid.at(float(pose[0]), float(pose[1])) < 50 for pose in poses])


def _global(
    field: LikelihoodField, drive: Callable[[int], Drive], starts: int, seed: int, progress: Callable[[str], None]
) -> dict[str, Any]:
    data = drive(1000 * seed)
    driven = driving_seconds(data)
    mapped = _on_floor(field, data.truth)
    # Evenly over all places in the map from which there is still enough to drive.
    possible = np.nonzero(mapped & (driven <= driven[-1] - FOUND_S))[0]
    if len(possible) == 0:
        raise ValueError("the log's last part has no place in the map from which 10 s are driven")
    chosen = possible[np.linspace(0, len(possible) - 1, starts).astype(int)]
    rows: list[dict[str, Any]] = []
    search_ms: list[float] = []
    for number, begin in enumerate(chosen):
        data = drive(1000 * seed + number)
        localisation = Localisation(field, np.random.default_rng((seed, number, 2)))
        index = int(begin)
        estimate = localisation.update(np.zeros(3), data.points[index])
        wrong = False
        sure_after: float | None = None
        while index + 1 < len(driven) and driven[index + 1] - driven[begin] <= FOUND_S:
            index += 1
            before = time.perf_counter()
            estimate = localisation.update(data.steps[index], data.points[index])
            if estimate.searched:
                search_ms.append(1000 * (time.perf_counter() - before))
            wrong |= estimate.sure and not is_right(estimate, data.truth[index])
            if estimate.sure and sure_after is None:
                sure_after = round(float(driven[index] - driven[begin]), 1)
        right = is_right(estimate, data.truth[index])
        seen = _on_floor(field, data.truth[begin : index + 1])
        rows.append(
            {
                "truth": np.round(data.truth[index], 2).tolist(),
                "estimate": np.round(estimate.pose, 2).tolist(),
                "right": right,
                "sure": estimate.sure,
                "sure_after_s": sure_after,
                "sure_and_wrong": wrong,
                "way_in_map": round(float(seen.mean()), 2),
            }
        )
        progress(f"start {number}: {'right' if right else 'wrong'}, {'sure' if estimate.sure else 'not sure'}")
    return {
        "global_starts": starts,
        "global_right": sum(row["right"] for row in rows),
        "global_sure": sum(row["sure"] for row in rows),
        "global_sure_and_wrong": sum(row["sure_and_wrong"] for row in rows),
        "global_in_map": sum(row["way_in_map"] >= IN_MAP for row in rows),
        "global_in_map_right": sum(row["way_in_map"] >= IN_MAP and row["right"] for row in rows),
        "global_each": rows,
        "search_p99_ms": round(float(np.percentile(search_ms, 99)), 1) if search_ms else None,
    }


def _kidnapped(
    field: LikelihoodField, drive: Callable[[int], Drive], kidnaps: int, seed: int, progress: Callable[[str], None]
) -> dict[str, Any]:
    data = drive(2000 * seed)
    driven = driving_seconds(data)
    mapped = _on_floor(field, data.truth)
    possible = np.nonzero(mapped & (driven >= 5) & (driven <= driven[-1] - FOUND_AGAIN_S))[0]
    random = np.random.default_rng((seed, 3))
    rows: list[dict[str, Any]] = []
    for number in range(kidnaps):
        data = drive(2000 * seed + number)
        places = [
            (int(a), int(b))
            for a, b in random.choice(possible, (200, 2))
            if errors_of(data.truth[a], data.truth[b])[0] > 3
        ]
        if not places:
            raise ValueError("the log's last part has no two places in the map that are 3 m apart")
        before, after = places[0]
        localisation = Localisation(field, np.random.default_rng((seed, number, 4)))
        first = int(np.searchsorted(driven, driven[before] - 5))
        localisation.place(data.truth[first], np.diag([0.04, 0.04, 0.01]))
        for index in range(first, before + 1):
            localisation.update(data.steps[index], data.points[index])
        # Carried to another place: the wheels did not turn.
        estimate = localisation.update(np.zeros(3), data.points[after])
        index = after
        when: float | None = None
        noticed: float | None = None
        wrong = False
        while index + 1 < len(driven) and driven[index + 1] - driven[after] <= FOUND_AGAIN_S:
            index += 1
            estimate = localisation.update(data.steps[index], data.points[index])
            now = round(float(driven[index] - driven[after]), 1)
            right = is_right(estimate, data.truth[index])
            if not estimate.sure and noticed is None:
                noticed = now
            # Until it is noticed it is sure of where it was.
            wrong |= noticed is not None and estimate.sure and not right
            if not (estimate.sure and right):
                when = None
            elif when is None:
                when = now
        seen = _on_floor(field, data.truth[after : index + 1])
        rows.append(
            {
                "truth": np.round(data.truth[index], 2).tolist(),
                "estimate": np.round(estimate.pose, 2).tolist(),
                "noticed_after_s": noticed,
                "found_after_s": when,
                "right": is_right(estimate, data.truth[index]),
                "sure": estimate.sure,
                "sure_and_wrong": wrong or (estimate.sure and when is None),
                "way_in_map": round(float(seen.mean()), 2),
            }
        )
        progress(f"kidnap {number}: found again after {when} s, sure {estimate.sure}")
    seconds = [row["found_after_s"] for row in rows if row["found_after_s"] is not None]
    return {
        "kidnaps": kidnaps,
        "kidnaps_right": sum(row["right"] for row in rows),
        "kidnaps_found_again": len(seconds),
        "kidnaps_found_p95_s": round(float(np.percentile(seconds, 95)), 1) if seconds else None,
        "kidnaps_sure_and_wrong": sum(row["sure_and_wrong"] for row in rows),
        "kidnaps_in_map": sum(row["way_in_map"] >= IN_MAP for row in rows),
        "kidnaps_in_map_right": sum(row["way_in_map"] >= IN_MAP and row["right"] for row in rows),
        "kidnaps_in_map_found_again": sum(
            row["way_in_map"] >= IN_MAP and row["found_after_s"] is not None for row in rows
        ),
        "kidnaps_each": rows,
    }
