"""``skytether lab run navigation``: the nine goals of the thesis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from skytether.lab.nine_goals import SCENARIOS, SERVICE, NineGoalsSettings, NineGoalsTrial
from skytether.lab.nine_goals_report import DEVICES, THESIS, THESIS_TRIALS, compare_times, summary, topics
from skytether.lab.nine_goals_result import NineGoalsResult
from skytether.lab.trial.scenario import Scenario
from skytether.lab.world.plan import building

from ...output import console, fail, print_json
from .trials import (
    Keep,
    OnDocker,
    Prefix,
    RobotCpu,
    Trials,
    beside_thesis,
    devices_table,
    fail_unless_completed,
    kept_trials,
    named_scenarios,
    on_docker,
    run_trials,
    topics_table,
    write_figures,
)

if TYPE_CHECKING:
    from rich.table import Table


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
    trials: Trials = 5,
    seed: Annotated[int, typer.Option(min=0, help="Of the first trial: noise and network. The others count on.")] = 1,
    goals: Annotated[int, typer.Option(min=1, max=9, help="Drive to the first so many.")] = 9,
    docker: OnDocker = False,
    prefix: Prefix = "skytether/",
    robot_cpu: RobotCpu = None,
    keep: Keep = None,
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
    wanted = _delays(rtt_ms, jitter_ms / 1000, loss) if rtt_ms else named_scenarios(scenario, SCENARIOS, robot_cpu)
    prefix = prefix if docker else ""
    asked = [_settings(one, compensation, seed + n, goals, prefix) for one in wanted for n in range(trials)]
    results = run_trials(asked, kept_trials(keep, NineGoalsResult), _drive, _told)
    _report(results, wanted[0].name, json=json)
    if figures is not None:
        _draw(results, figures, json=json)
    fail_unless_completed(
        results,
        lambda one: f"{one.goals} goals reached, {one.contacts} contacts; the service said: {one.message}",
    )


def _told(result: NineGoalsResult) -> str:
    return "completed" if result.completed else f"{result.goals} goals, {result.contacts} contacts"


def _report(results: Sequence[NineGoalsResult], baseline: str, *, json: bool) -> None:

    rows, times, quality = summary(results), compare_times(results, baseline), topics(results)
    if json:
        trials = [result.document() for result in results]
        print_json({"trials": trials, "summary": rows, "topics": quality, "times": times})
        return
    console.print(_table(rows))
    console.print(devices_table(rows, results, DEVICES, "Table 7"))
    caption = "Thesis: most topics below 2 %; the periods' medians near those as sent. It prints no figures of topics."
    console.print(topics_table(quality, "Figs. 38 and 39", caption))
    for row in times:
        theirs = "" if row["thesis_t"] is None else f" (thesis: t = {row['thesis_t']:.2f}, p = {row['thesis_p']:.3f})"
        console.print(
            f"{row['scenario']} against {row['against']}: {100 * row['slower']:+.1f} % in time, "
            f"Student's t = {row['t']:.2f}, p = {row['p']:.3f}{theirs}"
        )
    if times and times[0]["thesis_t"] is None:
        console.print("thesis, section 4.3.5: 112.5 s over all round trips, no difference at the level of 0.05")


def _draw(results: Sequence[NineGoalsResult], folder: Path, *, json: bool) -> None:
    from skytether.lab.nine_goals_figures import draw_figures

    write_figures(lambda: draw_figures(results, building(), folder), folder, json=json)


def _drive(settings: NineGoalsSettings, text: str) -> NineGoalsResult:
    """One trial, told of while it lasts."""
    with console.status(f"{text} ...") as line, NineGoalsTrial(settings) as trial:
        return trial.drive(
            lambda status: line.update(f"{text}, goal {status.get('goal', 0)}: {status.get('message', '')}")
        )


def _delays(rtts_ms: list[float], jitter_s: float, loss: float) -> list[Scenario]:

    return [Scenario(f"{rtt:g} ms", rtt / 1000, jitter_s, loss) for rtt in rtts_ms]


def _settings(scenario: Scenario, compensation: str, seed: int, goals: int, prefix: str) -> NineGoalsSettings:

    delay = {"compensation": compensation, **({"fixed_delay": scenario.rtt_s} if compensation == "fixed" else {})}
    scenario = replace(scenario, params={**scenario.params, "delay": delay})
    where = on_docker(prefix, SERVICE) if prefix else {}
    return NineGoalsSettings(scenario, seed, goals=goals, **where)


def _table(rows: list[dict[str, Any]]) -> Table:

    shown = {
        "time_s": "time [s]",
        "distance_m": "distance [m]",
        "first_leg_m": "goal 1 to 2 [m]",
        "mean_speed_m_s": "speed [m/s]",
        "rtt_ms": "round trip [ms]",
    }
    title = "Nine goals: mean and standard deviation, beside section 5.6.3 and Table 6"
    return beside_thesis(rows, shown, THESIS, title, thesis_trials=THESIS_TRIALS)
