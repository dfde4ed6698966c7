"""Benchmarks of the whole service in the simulated world: ``skytether lab bench navigation``.

The service's own code imports neither the laboratory nor the testing tools; this file, which no service runs, does.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from skytether.lab.world.plan import building
from skytether.testing.drive import Drive, StepTime

from .service import Navigation

STEP_BAR_MS = 10.0
"""99th percentile of a step with as many trajectories as are the default."""
MANY, MANY_BAR_MS = 2000, 33.0
"""From so many trajectories on a step may take as long as its period."""
_PATIENCE = 400.0
"""The drive has to be over by then, in simulated time [s]."""

Progress = Callable[[str], None]


def measure_steps(*, trajectories: int, goals: int, seed: int, progress: Progress) -> dict[str, Any]:
    """Time of a step of the loop, all of it: localisation, costmaps, planner, controller, messages.

    Args:
        trajectories: Of the controller in each step.
        goals: So many of the building's are driven to, at most.
        seed: Of the world's noise.
        progress: Told now and then how far it is.
    """
    plan = building()
    wanted = [{"x": goal.x, "y": goal.y, "yaw": goal.heading} for goal in plan.goals[:goals]]
    params = {"goals": wanted, "mppi": {"trajectories": trajectories}}
    began = time.perf_counter()
    progress("warming up ...")
    with TemporaryDirectory() as folder:
        warm = Drive(Navigation, Path(folder), params, plan, seed=seed)
        warm.run(3.0)
        warm_up = time.perf_counter() - began
        drive = Drive(Navigation, Path(folder), params, plan, seed=seed)

        def is_over() -> bool:
            if drive.world.ticks % 1000 == 0:
                progress(f"{drive.world.time:.0f} s driven")
            return drive.state in ("succeeded", "failed")

        drive.run(_PATIENCE, is_over)
    bar = STEP_BAR_MS if trajectories < MANY else MANY_BAR_MS
    document = {
        "trajectories": trajectories,
        "trajectory_steps": drive.harness.service.params.mppi.steps,
        "rate_hz": drive.harness.service.rate_hz,
        "goals": len(wanted),
        "state": drive.state,
        "driven_s": round(drive.world.time, 1),
        "driven_m": round(drive.robot.distance, 1),
        "contacts": len(drive.world.contacts),
        "warm_up_s": round(warm_up, 1),
        "steps": len(drive.times),
        **step_times(drive.times),
        "bar_p99_ms": bar,
    }
    document["within_bar"] = document["wall_p99_ms"] < bar
    return document


def step_times(times: list[StepTime]) -> dict[str, float]:
    """Median, 99th percentile and largest [ms]."""
    found = {}
    for name, column in zip(("wall", "cpu"), 1e3 * np.array(times).T, strict=True):
        found[f"{name}_p50_ms"] = round(float(np.percentile(column, 50)), 2)
        found[f"{name}_p99_ms"] = round(float(np.percentile(column, 99)), 2)
        found[f"{name}_max_ms"] = round(float(column.max()), 2)
    return found
