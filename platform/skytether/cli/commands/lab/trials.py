"""What the commands of `lab_run` share that run trials: the run, what is kept of it, tables of any experiment."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer
from rich.table import Table

from skytether.api.client import ApiError, Unreachable
from skytether.lab.embedded import EmbeddedError
from skytether.lab.trial.errors import TrialError
from skytether.lab.trial.report import devices
from skytether.lab.trial.results import KeptTrials
from skytether.lab.world.model import WorldError

from ...output import console, fail

if TYPE_CHECKING:
    from skytether.lab.trial.report import Pair
    from skytether.lab.trial.results import TrialResult
    from skytether.lab.trial.scenario import Scenario, TrialSettings

R = TypeVar("R", bound="TrialResult")
S = TypeVar("S", bound="TrialSettings")

Trials = Annotated[int, typer.Option(min=1, max=1000, help="Of each.")]
OnDocker = Annotated[bool, typer.Option("--docker", help="On this machine's engine, with the image present.")]
Prefix = Annotated[str, typer.Option(help="With --docker: of the images' names.")]
RobotCpu = Annotated[
    float | None,
    typer.Option(min=0.01, max=64, help="In `embedded`: processors that the service gets at most. Default: 0.25."),
]
Keep = Annotated[
    Path | None,
    typer.Option(help="File of JSON lines: trials that are in it are not done again, new ones are added."),
]
"""Options of any experiment."""


def kept_trials(file: Path | None, kind: type[R]) -> KeptTrials[R] | None:
    """What the option ``--keep`` names."""
    try:
        return KeptTrials(file, kind) if file is not None else None
    except (OSError, ValueError) as error:
        fail(str(error), 2)


def named_scenarios(
    names: Sequence[str] | None, known: Mapping[str, Scenario], robot_cpu: float | None
) -> list[Scenario]:
    """What the options ``--scenario`` and ``--robot-cpu`` name; without names all of them."""
    unknown = [name for name in names or () if name not in known]
    if unknown:
        fail(f"there is no scenario '{unknown[0]}'; there are {', '.join(known)}", 2)
    chosen = [known[name] for name in names or known]
    return [replace(one, cpu=robot_cpu) if robot_cpu and one.cpu else one for one in chosen]


def on_docker(prefix: str, service: str) -> dict[str, Any]:
    """Of `TrialSettings`, what the options ``--docker`` and ``--prefix`` ask for."""
    return {
        "docker": {"guard_image": f"{prefix}guard:1", "pull": "never"},
        "image": f"{prefix}{service}:1",
    }


def run_trials(
    asked: Iterable[S], kept: KeptTrials[R] | None, run: Callable[[S, str], R], told: Callable[[R], str]
) -> list[R]:
    """All trials, those that are kept aside.

    Args:
        asked: Trials.
        kept: Those that need not be done.
        run: Does one; given with what it is called while it lasts.
        told: What came of one, in some words.
    """
    results: list[R] = []
    try:
        for settings in asked:
            name, there = settings.scenario.name, kept.get(settings.document()) if kept is not None else None
            result = there or run(settings, f"{name}: seed {settings.seed}")
            if kept is not None and there is None:
                kept.put(settings.document(), result)
            results.append(result)
            was = " (kept)" if there else ""
            console.print(f"{name}, seed {result.seed}: {told(result)}, {result.time_s:.1f} s{was}")
    except (TrialError, EmbeddedError, WorldError, ApiError, Unreachable, OSError) as error:
        fail(str(error))
    return results


def write_figures(draw: Callable[[], list[Path]], folder: Path, *, json: bool) -> None:
    """What the option ``--figures`` asks for; says which files, but not beside JSON."""
    try:
        files = draw()
    except OSError as error:
        fail(f"{error.filename or folder}: {error.strerror}")
    if not json:
        for file in files:
            console.print(str(file), soft_wrap=True, markup=False)


def fail_unless_completed(results: Sequence[R], said: Callable[[R], str]) -> None:
    """End with an error if a trial was not completed.

    Args:
        results: All of them.
        said: What one is described by.
    """
    failed = [result for result in results if not result.completed]
    if failed:
        text = f"{len(failed)} of {len(results)} trials were not completed, first {failed[0].scenario} with seed"
        fail(f"{text} {failed[0].seed}: {said(failed[0])}")


def beside_thesis(
    rows: Sequence[Mapping[str, Any]],
    shown: Mapping[str, str],
    thesis: Mapping[str, Mapping[str, Pair]],
    title: str,
    *,
    thesis_trials: int = 0,
) -> Table:
    """Figures of each scenario above those of the thesis.

    Args:
        rows: Of the summary.
        shown: Figures with their headings.
        thesis: Its figures, by scenario.
        title: Above.
        thesis_trials: It did so many of each, all completed: shown with ours, and our contacts; 0: neither is shown.
    """
    made = Table("", *(("completed", "contacts") if thesis_trials else ()), *shown.values(), title=title)
    for row in rows:
        counted = (f"{row['completed']} of {row['trials']}", str(row["contacts"])) if thesis_trials else ()
        made.add_row(row["scenario"], *counted, *(pair(row[name], row[f"{name}_std"]) for name in shown))
        if told := thesis.get(row["scenario"]):
            counted = (f"{thesis_trials} of {thesis_trials}", "") if thesis_trials else ()
            figures = (pair(*told[name]) if name in told else "" for name in shown)
            made.add_row("  thesis", *counted, *figures, style="dim")
    return made


def devices_table(
    rows: Sequence[Mapping[str, Any]],
    results: Sequence[TrialResult],
    thesis: Mapping[str, Sequence[tuple[str, Pair, Pair]]],
    table: str,
) -> Table:
    """Processors and memory of each device, beside a table of the thesis.

    Args:
        rows: Of the summary.
        results: They tell where the service ran.
        thesis: By scenario of each device its name, processors [%], memory [MB].
        table: Name of the table.
    """
    on_robot = {result.scenario for result in results if result.on_robot}
    made = Table("", "", "processors [%]", "memory [MB]", title=f"Resources, beside {table}")
    for row in rows:
        for device, cpu, memory in devices(row, on_robot=row["scenario"] in on_robot):
            made.add_row(row["scenario"], device, pair(*cpu), pair(*memory))
        for device, cpu, memory in thesis.get(row["scenario"], ()):
            made.add_row("  thesis", device, pair(*cpu), pair(*memory), style="dim")
    made.caption = (
        "Ours: of one of this machine's processors; the robot's memory with the simulation.\n"
        "Thesis: of all processors of the device, with all that ran there."
    )
    return made


def topics_table(rows: Sequence[Mapping[str, Any]], figures: str, caption: str) -> Table:
    """Loss and periods of each topic.

    Args:
        rows: Of `skytether.lab.trial.report.topics`.
        figures: Those of the thesis that show the same.
        caption: Below the table.
    """
    made = Table(
        "", "topic", "lost [%]", "delay [ms]", "its change [ms]", "period [ms]", "99 % within [ms]", "as sent [ms]",
        title=f"Loss and jitter of each topic, as in {figures}",
    )  # fmt: skip
    for row in rows:
        lost = pair(100 * row["lost"], row["lost_std"] and 100 * row["lost_std"])
        times = [
            pair(row[name], row[f"{name}_std"]) for name in ("delay_ms", "jitter_ms", "period_ms", "period_p99_ms")
        ]
        made.add_row(row["scenario"], row["topic"], lost, *times, pair(row["ideal_ms"], None))
    made.caption = caption
    return made


def pair(mean: float | None, deviation: float | None) -> str:
    """Mean and standard deviation as text; empty where there is none."""
    if mean is None or math.isnan(mean):
        return ""
    if deviation is None or math.isnan(deviation):
        return f"{mean:.3g}"
    return f"{mean:.4g} ± {deviation:.0f}" if deviation >= 100 else f"{mean:.4g} ± {deviation:.2g}"
