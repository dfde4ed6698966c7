"""``skytether lab run``: experiments of the thesis that drive a service as a robot does."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .lab_building import building
from .output import console, fail, print_json

if TYPE_CHECKING:
    from rich.table import Table

    from skytether.lab.nine_goals import Scenario, TrialSettings
    from skytether.lab.nine_goals_result import KeptTrials, TrialResult

app = typer.Typer(help="Experiments of the thesis that drive a service as a robot does.", no_args_is_help=True)


app.command()(building)


@app.command()
def navigation(
    scenario: Annotated[
        list[str] | None,
        typer.Option(help="embedded, edge, commercial or private (section 5.6); may be repeated. Default: all four."),
    ] = None,
    rtt_ms: Annotated[
        list[float] | None,
        typer.Option(min=0, max=5000, help="In place of a scenario: this round trip (section 4.3.5); may be repeated."),
    ] = None,
    jitter_ms: Annotated[float, typer.Option(min=0, max=1000, help="With --rtt-ms: deviation of the round trip.")] = 0,
    loss: Annotated[float, typer.Option(min=0, max=0.9, help="With --rtt-ms: share of round trips lost.")] = 0,
    compensation: Annotated[
        str, typer.Option(help="Of the delay: measured, off, or fixed (at the round trip).")
    ] = "measured",
    trials: Annotated[int, typer.Option(min=1, max=1000, help="Of each.")] = 5,
    seed: Annotated[int, typer.Option(min=0, help="Of the first trial: noise and network. The others count on.")] = 1,
    goals: Annotated[int, typer.Option(min=1, max=9, help="Drive to the first so many.")] = 9,
    docker: Annotated[bool, typer.Option("--docker", help="On this machine's engine, with the image present.")] = False,
    prefix: Annotated[str, typer.Option(help="With --docker: of the images' names.")] = "skytether/",
    robot_cpu: Annotated[
        float | None,
        typer.Option(min=0.01, max=64, help="In `embedded`: processors that the service gets at most. Default: 0.25."),
    ] = None,
    keep: Annotated[
        Path | None,
        typer.Option(help="File of JSON lines: trials that are in it are not done again, new ones are added."),
    ] = None,
    figures: Annotated[Path | None, typer.Option(help="Folder for PNGs, drawn like Figs. 36 to 39.")] = None,
    json: Annotated[
        bool, typer.Option("--json", help="Print `trials`, `summary`, `topics`, `times` as one object.")
    ] = False,
) -> None:
    """Drive a simulated robot to nine goals with the service navigation, a person in its way (thesis, section 5.6).

    Each trial takes about two minutes: it is done in real time, by an orchestrator, a service and an agent of its own.
    With --keep a run that was stopped goes on where it was. Ends with exit status 0 only if all trials reached all
    goals and touched nothing.
    """
    if compensation not in ("measured", "off", "fixed"):
        fail(f"--compensation must be measured, off or fixed, not '{compensation}'", 2)
    wanted = _delays(rtt_ms, jitter_ms / 1000, loss) if rtt_ms else _named(scenario, robot_cpu)
    prefix = prefix if docker else ""
    asked = [[_settings(one, compensation, seed + n, goals, prefix) for n in range(trials)] for one in wanted]
    results = _drive_all(asked, _kept(keep))
    _report(results, wanted[0].name, json=json)
    if figures is not None:
        _draw(results, figures, json=json)
    failed = [result for result in results if not result.completed]
    if failed:
        first = failed[0]
        text = f"{len(failed)} of {len(results)} trials were not completed, first {first.scenario} with seed"
        said = f"{first.goals} goals reached, {first.contacts} contacts; the service said: {first.message}"
        fail(f"{text} {first.seed}: {said}")


def _kept(file: Path | None) -> KeptTrials | None:
    from skytether.lab.nine_goals_result import KeptTrials

    try:
        return KeptTrials(file) if file is not None else None
    except (OSError, ValueError) as error:
        fail(str(error), 2)


def _drive_all(asked: list[list[TrialSettings]], kept: KeptTrials | None) -> list[TrialResult]:
    """All trials, those that are kept aside."""
    from skytether.api.client import ApiError, Unreachable
    from skytether.lab.embedded import EmbeddedError
    from skytether.lab.nine_goals import TrialError
    from skytether.lab.world.model import WorldError

    results: list[TrialResult] = []
    try:
        for settings in (one for scenario in asked for one in scenario):
            name, there = settings.scenario.name, kept.get(settings.document()) if kept is not None else None
            result = there or _drive(settings, f"{name}: seed {settings.seed}")
            if kept is not None and there is None:
                kept.put(settings.document(), result)
            results.append(result)
            reached = "completed" if result.completed else f"{result.goals} goals, {result.contacts} contacts"
            was = " (kept)" if there else ""
            console.print(f"{name}, seed {result.seed}: {reached}, {result.time_s:.1f} s{was}")
    except (TrialError, EmbeddedError, WorldError, ApiError, Unreachable, OSError) as error:
        fail(str(error))
    return results


def _report(results: list[TrialResult], baseline: str, *, json: bool) -> None:
    from skytether.lab.nine_goals_report import compare_times, summary, topics

    rows, times, quality = summary(results), compare_times(results, baseline), topics(results)
    if json:
        trials = [result.document() for result in results]
        print_json({"trials": trials, "summary": rows, "topics": quality, "times": times})
        return
    console.print(_table(rows))
    console.print(_devices_table(rows, {result.scenario for result in results if result.on_robot}))
    console.print(_topics_table(quality))
    for row in times:
        theirs = "" if row["thesis_t"] is None else f" (thesis: t = {row['thesis_t']:.2f}, p = {row['thesis_p']:.3f})"
        console.print(
            f"{row['scenario']} against {row['against']}: {100 * row['slower']:+.1f} % in time, "
            f"Student's t = {row['t']:.2f}, p = {row['p']:.3f}{theirs}"
        )
    if times and times[0]["thesis_t"] is None:
        console.print("thesis, section 4.3.5: 112.5 s over all round trips, no difference at the level of 0.05")


def _draw(results: list[TrialResult], folder: Path, *, json: bool) -> None:
    from skytether.lab.nine_goals_figures import draw_figures
    from skytether.lab.world.plan import building

    try:
        files = draw_figures(results, building(), folder)
    except OSError as error:
        fail(f"{error.filename or folder}: {error.strerror}")
    if not json:
        for file in files:
            console.print(str(file), soft_wrap=True, markup=False)


def _drive(settings: TrialSettings, text: str) -> TrialResult:
    """One trial, told of while it lasts."""
    from skytether.lab.nine_goals import Trial

    with console.status(f"{text} ...") as line, Trial(settings) as trial:
        return trial.drive(
            lambda status: line.update(f"{text}, goal {status.get('goal', 0)}: {status.get('message', '')}")
        )


def _named(names: list[str] | None, robot_cpu: float | None) -> list[Scenario]:
    from skytether.lab.nine_goals import SCENARIOS

    unknown = [name for name in names or () if name not in SCENARIOS]
    if unknown:
        fail(f"there is no scenario '{unknown[0]}'; there are {', '.join(SCENARIOS)}", 2)
    chosen = [SCENARIOS[name] for name in names or SCENARIOS]
    return [replace(one, cpu=robot_cpu) if robot_cpu and one.cpu else one for one in chosen]


def _delays(rtts_ms: list[float], jitter_s: float, loss: float) -> list[Scenario]:
    from skytether.lab.nine_goals import Scenario

    return [Scenario(f"{rtt:g} ms", rtt / 1000, jitter_s, loss) for rtt in rtts_ms]


def _settings(scenario: Scenario, compensation: str, seed: int, goals: int, prefix: str) -> TrialSettings:
    from skytether.lab.nine_goals import SERVICE, TrialSettings

    delay = {"compensation": compensation, **({"fixed_delay": scenario.rtt_s} if compensation == "fixed" else {})}
    scenario = replace(scenario, params={**scenario.params, "delay": delay})
    if not prefix:
        return TrialSettings(scenario, seed, goals=goals)
    options = {"guard_image": f"{prefix}guard:1", "pull": "never"}
    return TrialSettings(scenario, seed, options, f"{prefix}{SERVICE}:1", goals)


def _table(rows: list[dict[str, Any]]) -> Table:
    from rich.table import Table

    from skytether.lab.nine_goals_report import THESIS, THESIS_TRIALS

    table = Table(
        "", "completed", "contacts", "time [s]", "distance [m]", "goal 1 to 2 [m]", "speed [m/s]", "round trip [ms]",
        title="Nine goals: mean and standard deviation, beside section 5.6.3 and Table 6",
    )  # fmt: skip
    shown = ("time_s", "distance_m", "first_leg_m", "mean_speed_m_s", "rtt_ms")
    for row in rows:
        figures = [_pair(row[name], row[f"{name}_std"]) for name in shown]
        table.add_row(row["scenario"], f"{row['completed']} of {row['trials']}", str(row["contacts"]), *figures)
        thesis = THESIS.get(row["scenario"])
        if thesis:
            told = [_pair(*thesis[name]) if name in thesis else "" for name in shown]
            table.add_row("  thesis", f"{THESIS_TRIALS} of {THESIS_TRIALS}", "", *told, style="dim")
    return table


def _devices_table(rows: list[dict[str, Any]], on_robot: set[str]) -> Table:
    """Table 7."""
    from rich.table import Table

    from skytether.lab.nine_goals_report import DEVICES, devices

    table = Table("", "", "processors [%]", "memory [MB]", title="Resources, beside Table 7")
    for row in rows:
        for device, cpu, memory in devices(row, on_robot=row["scenario"] in on_robot):
            table.add_row(row["scenario"], device, _pair(*cpu), _pair(*memory))
        for device, cpu, memory in DEVICES.get(row["scenario"], ()):
            table.add_row("  thesis", device, _pair(*cpu), _pair(*memory), style="dim")
    table.caption = (
        "Ours: of one of this machine's processors; the robot's memory with the simulation.\n"
        "Thesis: of all processors of the device, with all that ran there."
    )
    return table


def _topics_table(rows: list[dict[str, Any]]) -> Table:
    """Figs. 38 and 39 in numbers."""
    from rich.table import Table

    table = Table(
        "", "topic", "lost [%]", "delay [ms]", "its change [ms]", "period [ms]", "99 % within [ms]", "as sent [ms]",
        title="Loss and jitter of each topic, as in Figs. 38 and 39",
    )  # fmt: skip
    for row in rows:
        lost = _pair(100 * row["lost"], row["lost_std"] and 100 * row["lost_std"])
        times = [
            _pair(row[name], row[f"{name}_std"]) for name in ("delay_ms", "jitter_ms", "period_ms", "period_p99_ms")
        ]
        table.add_row(row["scenario"], row["topic"], lost, *times, _pair(row["ideal_ms"], None))
    table.caption = (
        "Thesis: most topics below 2 %; the periods' medians near those as sent. It prints no figures of topics."
    )
    return table


def _pair(mean: float | None, deviation: float | None) -> str:
    if mean is None or math.isnan(mean):
        return ""
    if deviation is None or math.isnan(deviation):
        return f"{mean:.3g}"
    return f"{mean:.4g} ± {deviation:.0f}" if deviation >= 100 else f"{mean:.4g} ± {deviation:.2g}"
