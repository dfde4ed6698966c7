"""Benchmarks of the service ``navigation``, on recorded logs and in the simulated world, found by entry point.

The platform imports no service: what is measured belongs to whoever installs an entry point of the group
``skytether.benches``, in ``pyproject.toml``::

    [project.entry-points."skytether.benches"]
    mapping = "skytether_services.navigation.bench_mapping:build"
    localisation = "skytether_services.navigation.bench_localisation:run"
    navigation = "skytether_services.navigation.bench_loop:measure_steps"
    navigation-cluttered = "skytether_services.navigation.bench_courses:measure_cluttered"
    navigation-delays = "skytether_services.navigation.bench_courses:measure_delays"

Those on logs are functions of plain arrays (a service cannot import `skytether.lab`): `MappingBench` and
`LocalisationBench` are their shapes. `StepBench`, `DelaysBench` and `ClutteredBench` drive the service in the simulated
world. After adding a line to
``pyproject.toml``, reinstall (``pip install -e .``).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from skytether.lab.carmen import CarmenLog
from skytether.lab.world.model import WorldError
from skytether.lab.world.plan import Plan

GROUP = "skytether.benches"

Floats = NDArray[np.float64]


class BuiltMap(Protocol):
    """What mapping makes of a log."""

    @property
    def poses(self) -> Floats:
        """Pose of the laser at each scan, n by (x [m], y [m], theta [rad])."""
        ...

    def save(self, path: Path) -> list[Path]:
        """Write the occupancy map as YAML and PGM of map_server, and as PNG; the files that were written."""
        ...


class MappingBench(Protocol):
    """The entry point ``mapping``."""

    def __call__(
        self,
        *,
        stamps: Floats,
        ranges: NDArray[np.float32],
        angles: Floats,
        max_range: float,
        odometry: Floats | None,
        progress: Callable[[str], None],
    ) -> BuiltMap:
        """Build a map.

        Args:
            stamps: Of the scans, n, never falling [s].
            ranges: n by rays [m]; NaN, and what is ``max_range`` or more, was not seen.
            angles: Of the rays, anticlockwise from straight ahead [rad].
            max_range: From here on a reading means that nothing was seen [m].
            odometry: Pose of the robot by odometry at each scan, n by 3; None: from the laser only.
            progress: Told now and then how far it is.
        """
        ...


class LocalisationBench(Protocol):
    """The entry point ``localisation``."""

    def __call__(
        self,
        *,
        stamps: Floats,
        ranges: NDArray[np.float32],
        angles: Floats,
        max_range: float,
        laser: Floats,
        odometry: Floats,
        seeds: Sequence[int],
        progress: Callable[[str], None],
        starts: int,
        kidnaps: int,
    ) -> dict[str, Any]:
        """Measure localisation.

        Args:
            stamps: Of the scans.
            ranges: Of the scans.
            angles: Of the rays.
            max_range: Of the laser.
            laser: Corrected pose of the laser at each scan, the truth.
            odometry: Of the log. It may be but the laser's pose: add the noise to its increments.
            seeds: One run for each.
            progress: Told now and then how far it is.
            starts: So many times the robot is to be found without a first pose.
            kidnaps: So many times it is carried away.

        Returns:
            What is printed: ``position_mean_m, position_p95_m, heading_mean_deg, lost, seeds, update_p99_ms``, the same
            of processor time, ``update_cpu_p99_ms``, and more with starts and kidnaps.

        Raises:
            ValueError: The log is not good for it; the text says why.
        """
        ...


class StepBench(Protocol):
    """The entry point ``navigation``."""

    def __call__(self, *, trajectories: int, goals: int, seed: int, progress: Callable[[str], None]) -> dict[str, Any]:
        """Measure the time of the loop's steps while the robot drives through the simulated building.

        Args:
            trajectories: Tried in each step.
            goals: So many of the building's.
            seed: Of the world's noise.
            progress: Told now and then how far it is.

        Returns:
            What is printed: ``wall_p50_ms, wall_p99_ms, cpu_p50_ms, cpu_p99_ms, bar_p99_ms, within_bar``, and what was
            driven.

        Raises:
            skytether.lab.world.model.WorldError: The simulated world cannot be made.
        """
        ...


class DelaysBench(Protocol):
    """The entry point ``navigation-delays``."""

    def __call__(
        self,
        *,
        plan: Plan,
        goals: int,
        runs: int,
        seed: int,
        jitter_only: bool,
        progress: Callable[[str], None],
    ) -> dict[str, Any]:
        """Drive over links of more and more delay, with each compensation.

        Args:
            plan: Of the world; its people are left out.
            goals: So many of the plan's.
            runs: Over each link with each compensation.
            seed: The first of the world's noise and the link's.
            jitter_only: Only the link with jitter and loss, and, measured, the one without delay.
            progress: Told before each drive.

        Returns:
            ``time_within_bar`` (not with ``jitter_only``), ``measured_beats_fixed, measured_halves_off``,
            ``fixed_against_measured`` (t-tests: ``test`` is how, ``paired``; ``difference, low, high, t, p``), and
            ``rows``: ``round_trip, jitter, loss, told, compensation, state, contacts``, and means over the runs, with
            ``_std`` and ``_each``: ``seconds, path_error, prediction_error, prediction_across``.

        Raises:
            skytether.lab.world.model.WorldError: The simulated world cannot be made.
        """
        ...


class ClutteredBench(Protocol):
    """The entry point ``navigation-cluttered``."""

    def __call__(self, *, worlds: int, runs: int, seed: int, progress: Callable[[str], None]) -> dict[str, Any]:
        """Drive through cluttered fields.

        Args:
            worlds: So many fields.
            runs: In each.
            seed: Of the fields, and the first of the noise.
            progress: Told before each world.

        Returns:
            ``success, score, within_bar``, and ``rows``, each a drive.

        Raises:
            skytether.lab.world.model.WorldError: The simulated world cannot be made.
        """
        ...


class NavigationBenchError(Exception):
    """The benchmark's algorithm cannot be had; the text says why and what to do."""


def load(name: str, extra: str = "navigation") -> Any:
    """Find an algorithm by the name of its entry point.

    Args:
        name: Of the entry point.
        extra: What brings the libraries that it needs.

    Raises:
        NavigationBenchError: There is none of that name, or it cannot be imported.
    """
    found = {entry.name: entry for entry in entry_points(group=GROUP)}
    if name not in found:
        known = ", ".join(sorted(found)) or "none: is Skytether installed?"
        raise NavigationBenchError(f"there is no benchmark '{name}'; known are: {known}")
    try:
        return found[name].load()
    except ImportError as error:
        raise NavigationBenchError(
            f"benchmark '{name}' cannot be loaded from {found[name].value}: {error}; "
            f"install the extra: pip install 'skytether[{extra}]'"
        ) from error
    except Exception as error:  # whatever a broken plug-in raises at import
        raise NavigationBenchError(f"benchmark '{name}' cannot be loaded from {found[name].value}: {error}") from error


def bench_localisation(
    log: CarmenLog, seeds: Sequence[int], progress: Callable[[str], None], *, starts: int = 0, kidnaps: int = 0
) -> dict[str, Any]:
    """Call the entry point ``localisation`` with a log.

    Raises:
        NavigationBenchError: It is not installed, or the log is not good for it.
    """
    run = cast(LocalisationBench, load("localisation"))
    try:
        return run(
            stamps=log.stamps,
            ranges=log.ranges,
            angles=log.angles,
            max_range=log.max_range,
            laser=log.laser,
            odometry=log.odometry,
            seeds=seeds,
            progress=progress,
            starts=starts,
            kidnaps=kidnaps,
        )
    except ValueError as error:
        raise NavigationBenchError(str(error)) from error


def bench_driving(name: str, **given: Any) -> dict[str, Any]:
    """Call one of the entry points that drive in the simulated world.

    Args:
        name: ``navigation``, ``navigation-delays`` or ``navigation-cluttered``.
        given: What it takes: `StepBench`, `DelaysBench`, `ClutteredBench`.

    Raises:
        NavigationBenchError: It is not installed, or the simulated world is not.
    """
    run = cast(Callable[..., dict[str, Any]], load(name))
    try:
        return run(**given)
    except WorldError as error:
        raise NavigationBenchError(str(error)) from error
