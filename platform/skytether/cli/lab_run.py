"""``skytether lab run``: experiments of the thesis that drive a service as a robot does."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .output import console, fail, print_json

if TYPE_CHECKING:
    from rich.table import Table

    from skytether.lab.nine_goals import Scenario, TrialResult, TrialSettings

app = typer.Typer(help="Experiments of the thesis that drive a service as a robot does.", no_args_is_help=True)


@app.callback()
def _run() -> None:
    """Keeps the name of the one command."""


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
    json: Annotated[bool, typer.Option("--json", help="Print `trials`, `summary`, `times` as one object.")] = False,
) -> None:
    """Drive a simulated robot to nine goals with the service navigation, a person in its way (thesis, section 5.6).

    Each trial takes about two minutes: it is done in real time, by an orchestrator, a service and an agent of its own.
    Ends with exit status 0 only if all of them reached all goals and touched nothing.
    """
    from skytether.api.client import ApiError, Unreachable
    from skytether.lab.embedded import EmbeddedError
    from skytether.lab.nine_goals import TrialError
    from skytether.lab.nine_goals_report import compare_times, summary
    from skytether.lab.world.model import WorldError

    if compensation not in ("measured", "off", "fixed"):
        fail(f"--compensation must be measured, off or fixed, not '{compensation}'", 2)
    wanted = _delays(rtt_ms, jitter_ms / 1000, loss) if rtt_ms else _named(scenario)
    results: list[TrialResult] = []
    try:
        for one in wanted:
            for number in range(trials):
                settings = _settings(one, compensation, seed + number, goals, prefix if docker else "")
                result = _drive(settings, f"{one.name}: trial {number + 1} of {trials}")
                results.append(result)
                reached = "completed" if result.completed else f"{result.goals} goals, {result.contacts} contacts"
                console.print(f"{one.name}, seed {result.seed}: {reached}, {result.time_s:.1f} s")
    except (TrialError, EmbeddedError, WorldError, ApiError, Unreachable) as error:
        fail(str(error))
    rows, times = summary(results), compare_times(results, wanted[0].name) if len(wanted) > 1 else []
    if json:
        print_json({"trials": [result.document() for result in results], "summary": rows, "times": times})
    else:
        console.print(_table(rows))
        for row in times:
            console.print(
                f"{row['scenario']} against {row['against']}: {100 * row['slower']:+.1f} % in time, "
                f"t = {row['t']:.2f}, p = {row['p']:.3f}"
            )
    failed = [result for result in results if not result.completed]
    if failed:
        first = failed[0]
        text = f"{len(failed)} of {len(results)} trials were not completed, first {first.scenario} with seed"
        said = f"{first.goals} goals reached, {first.contacts} contacts; the service said: {first.message}"
        fail(f"{text} {first.seed}: {said}")


def _drive(settings: TrialSettings, text: str) -> TrialResult:
    """One trial, told of while it lasts."""
    from skytether.lab.nine_goals import Trial

    with console.status(f"{text} ...") as line, Trial(settings) as trial:
        return trial.drive(
            lambda status: line.update(f"{text}, goal {status.get('goal', 0)}: {status.get('message', '')}")
        )


def _named(names: list[str] | None) -> list[Scenario]:
    from skytether.lab.nine_goals import SCENARIOS

    unknown = [name for name in names or () if name not in SCENARIOS]
    if unknown:
        fail(f"there is no scenario '{unknown[0]}'; there are {', '.join(SCENARIOS)}", 2)
    return [SCENARIOS[name] for name in names or SCENARIOS]


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

    from skytether.lab.nine_goals_report import THESIS

    table = Table(
        "", "completed", "time [s]", "distance [m]", "goal 1 to 2 [m]", "speed [m/s]", "round trip [ms]",
        "robot [cores]", "service [cores]", "service [MB]", title="Nine goals: mean and standard deviation",
    )  # fmt: skip
    shown = ("time_s", "distance_m", "first_leg_m", "mean_speed_m_s", "rtt_ms")
    for row in rows:
        figures = [_pair(row[name], row[f"{name}_std"]) for name in (*shown, "robot_cpu", "service_cpu")]
        memory = _pair(row["service_memory_mb"], row["service_memory_mb_std"])
        table.add_row(row["scenario"], f"{row['completed']} of {row['trials']}", *figures, memory)
        thesis = THESIS.get(row["scenario"])
        if thesis:
            told = [_pair(*thesis[name]) if name in thesis else "" for name in shown]
            table.add_row("  thesis", "5 of 5", *told, "", "", "", style="dim")
    return table


def _pair(mean: float | None, deviation: float | None) -> str:
    if mean is None:
        return ""
    return f"{mean:.3g}" if deviation is None else f"{mean:.4g} ± {deviation:.2g}"
