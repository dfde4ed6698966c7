"""How good a map is that the service ``navigation`` builds of a recorded log, and what it takes."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, Literal, cast, get_args

import numpy as np
from numpy.typing import NDArray

from skytether.lab.carmen import CarmenError, CarmenLog, read_log, read_relations
from skytether.lab.relations import Errors, relative, score

from .navigation import MappingBench, load

Floats = NDArray[np.float64]

Odometry = Literal["noisy", "recorded", "laser"]
ODOMETRY: tuple[Odometry, ...] = get_args(Odometry)
NOISE = 0.1
"""Of the odometry: metre for each metre, radian for each radian, on each motion from scan to scan."""


def noisy(odometry: Floats, seed: int) -> Floats:
    """Odometry with noise on each of its motions: normal, 0.1 m for a metre along and across, 0.1 rad for a radian.

    Args:
        odometry: Poses, n by (x [m], y [m], theta [rad]).
        seed: Of the noise.
    """
    motions = relative(odometry[:-1], odometry[1:])
    noise = np.random.default_rng(seed).standard_normal(motions.shape)
    size = np.hypot(motions[:, 0], motions[:, 1])
    motions += NOISE * noise * np.stack([size, size, np.abs(motions[:, 2])], axis=1)
    theta = odometry[0, 2] + np.concatenate([[0.0], np.cumsum(motions[:, 2])])
    cos, sin = np.cos(theta[:-1]), np.sin(theta[:-1])
    steps = np.stack([cos * motions[:, 0] - sin * motions[:, 1], sin * motions[:, 0] + cos * motions[:, 1]], axis=1)
    places = odometry[0, :2] + np.vstack([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    return np.column_stack([places, theta])


def bench_mapping(
    log: Path,
    relations: Path | None,
    *,
    stamp_offset: float = 0.0,
    fov: float | None = None,
    odometry: Odometry = "noisy",
    seeds: range = range(1, 2),
    save: Path | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:
    """Build the map once for each seed, and compare it with the official relations.

    Args:
        log: CARMEN log.
        relations: File of relations; None: nothing to compare with.
        stamp_offset: Added to their stamps to have the log's [s].
        fov: Field of view of the laser [rad]; None: the usual one of so many rays.
        odometry: ``noisy``: the log's with noise added to its motions; ``recorded``: as it is; ``laser``: none.
        seeds: Of the noise; without noise all runs are the same.
        save: YAML file for the map of the first seed.
        progress: Told now and then how far it is.

    Returns:
        Means over the seeds, `wall_s` and `peak_mb` of the worst; None for what nothing was to compare with.

    Raises:
        CarmenError: The log or the relations cannot be used.
        NavigationBenchError: The service's algorithms are not installed.
    """
    began = time.perf_counter()
    recorded = read_log(log, fov=fov)
    truth = read_relations(relations) if relations else None
    if truth is not None:
        score(recorded.stamps, recorded.laser, truth, stamp_offset)  # a wrong offset is told at once
    # Last, for it takes seconds where numba has to be loaded: a file that is no log is refused at once.
    build = cast(MappingBench, load("mapping"))
    reading_s = time.perf_counter() - began
    process_s = time.process_time()
    runs = []
    files: list[str] = []
    for seed in seeds:
        started = time.perf_counter()
        built = build(
            stamps=recorded.stamps,
            ranges=recorded.ranges,
            angles=recorded.angles,
            max_range=recorded.max_range,
            odometry=_given(recorded, odometry, seed),
            progress=partial(_report, progress, seed),
        )
        if built.poses.shape != recorded.laser.shape or not np.isfinite(built.poses).all():
            raise CarmenError(f"{log}: mapping gave no pose for some scans")
        wall_s = reading_s + time.perf_counter() - started
        found = score(recorded.stamps, built.poses, truth, stamp_offset) if truth is not None else None
        runs.append((seed, wall_s, found))
        if save is not None and not files:
            files = [str(path) for path in built.save(save)]
    scores = [found for _, _, found in runs if found is not None]
    return {
        **_mean([found.all for found in scores]),
        "wall_s": round(max(wall_s for _, wall_s, _ in runs), 2),
        "cpu_s": round(reading_s + (time.process_time() - process_s) / len(runs), 2),
        "peak_mb": round(peak_mb(), 1),
        "neighbours": _mean([found.neighbours for found in scores]),
        "loops": _mean([found.loops for found in scores]),
        "scans": len(recorded.stamps),
        "odometry": odometry,
        "seeds": len(runs),
        "broken_lines": [number for number, _ in recorded.broken],
        "runs": [
            {"seed": seed, "wall_s": round(wall_s, 2), **(_mean([found.all]) if found else {})}
            for seed, wall_s, found in runs
        ],
        "files": files,
    }


def _report(progress: Callable[[str], None], seed: int, line: str) -> None:
    progress(f"seed {seed}: {line}")


def _given(log: CarmenLog, odometry: Odometry, seed: int) -> Floats | None:
    if odometry == "laser":
        return None
    return log.odometry if odometry == "recorded" else noisy(log.odometry, seed)


def _mean(errors: list[Errors]) -> dict[str, float | int | None]:
    """Each figure's mean over the runs."""
    names = ("translation_mean_m", "translation_std_m", "rotation_mean_deg", "rotation_std_deg")
    if not errors:
        return {**dict.fromkeys(names), "relations": 0}
    tables = [asdict(error) for error in errors]
    means = {name: sum(table[name] for table in tables) / len(tables) for name in names}
    return {
        **{name: round(mean, 5) if math.isfinite(mean) else None for name, mean in means.items()},
        "relations": errors[0].relations,
    }


def peak_mb() -> float:
    """The most memory that this process had resident, of everything in it [MB]."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) * 1024 / 1e6
    return math.nan
