"""``skytether lab run follow-in-front``: the round on the lemniscate of the thesis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from skytether.lab.follow_in_front_report import DEVICES, THESIS, THESIS_TRIALS, summary, topics
from skytether.lab.follow_in_front_result import FollowResult

from ...output import console, print_json
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

    from skytether.lab.follow_in_front import FollowSettings
    from skytether.lab.trial.scenario import Scenario


def follow_in_front(
    scenario: Annotated[
        list[str] | None,
        typer.Option(help="embedded, edge or commercial (section 5.5.2); may be repeated. Default: all three."),
    ] = None,
    trials: Trials = 5,
    seed: Annotated[
        int, typer.Option(min=0, help="Of the first trial: noise, network and operator. The others count on.")
    ] = 1,
    predict: Annotated[
        bool, typer.Option("--predict/--no-predict", help="Whether the service counts on for the round trip's length.")
    ] = True,
    docker: OnDocker = False,
    prefix: Prefix = "skytether/",
    robot_cpu: RobotCpu = None,
    keep: Keep = None,
    figures: Annotated[Path | None, typer.Option(help="Folder for PNGs: ways, and Figs. 31 to 33.")] = None,
    json: Annotated[bool, typer.Option("--json", help="Print `trials`, `summary`, `topics` as one object.")] = False,
) -> None:
    """A simulated person steers a robot ahead of them by the face, one round of a lemniscate (thesis, section 5.5).

    Each trial takes about a minute: it is done in real time, by an orchestrator, the service follow-in-front and an
    agent of its own. With --keep a run that was stopped goes on where it was. Ends with exit status 0 only if in all
    trials the robot came round ahead of the person, and touched nothing.
    """
    from skytether.lab.follow_in_front import SCENARIOS

    wanted = named_scenarios(scenario, SCENARIOS, robot_cpu)
    prefix = prefix if docker else ""
    asked = [_settings(one, seed + n, prefix, predict=predict) for one in wanted for n in range(trials)]
    results = run_trials(asked, kept_trials(keep, FollowResult), _run, _told)
    _report(results, json=json)
    if figures is not None:
        _draw(results, figures, json=json)
    fail_unless_completed(results, lambda one: f"{_told(one)}; the service said: {one.message}")


def _settings(scenario: Scenario, seed: int, prefix: str, *, predict: bool) -> FollowSettings:
    from skytether.lab.follow_in_front import SERVICE, FollowSettings

    scenario = replace(scenario, params={**scenario.params, "predict": predict})
    return FollowSettings(scenario, seed, **(on_docker(prefix, SERVICE) if prefix else {}))


def _run(settings: FollowSettings, text: str) -> FollowResult:
    """One trial, told of while it lasts."""
    from skytether.lab.follow_in_front import FollowTrial

    with console.status(f"{text} ...") as line, FollowTrial(settings) as trial:
        return trial.drive(
            lambda share, status: line.update(f"{text}, {share:.0%} of the round: {status.get('message', '')}")
        )


def _told(result: FollowResult) -> str:
    if result.completed:
        return f"completed, KTE {result.kte_m:.3f} m"
    lost = ", the operator lost the robot" if result.lost else ""
    return f"{result.round:.0%} of the round, {result.contacts} contacts{lost}"


def _report(results: Sequence[FollowResult], *, json: bool) -> None:

    rows, quality = summary(results), topics(results)
    if json:
        print_json({"trials": [result.document() for result in results], "summary": rows, "topics": quality})
        return
    console.print(_table(rows))
    console.print(_network_table(rows))
    console.print(devices_table(rows, results, DEVICES, "Table 3"))
    console.print(topics_table(quality, "Figs. 32 and 33", "Thesis: it prints no figures of topics."))


def _draw(results: Sequence[FollowResult], folder: Path, *, json: bool) -> None:
    from skytether.lab.follow_in_front_figures import draw_figures

    write_figures(lambda: draw_figures(results, folder), folder, json=json)


def _table(rows: list[dict[str, Any]]) -> Table:

    shown = {
        "time_s": "time [s]",
        "mean_speed_m_s": "speed [m/s]",
        "kte_m": "KTE [m]",
        "deviation_max_m": "farthest off [m]",
        "following": "share following",
    }
    made = beside_thesis(rows, shown, THESIS, "One round: mean and standard deviation", thesis_trials=THESIS_TRIALS)
    made.caption = f"Thesis: section 5.5.3, {THESIS_TRIALS} trials each; its speeds' deviations are as printed there."
    return made


def _network_table(rows: list[dict[str, Any]]) -> Table:

    shown = {
        "rtt_ms": "round trip [ms]",
        "up_mbit_s": "robot sent [Mbit/s]",
        "up_arrived_mbit_s": "arrived",
        "down_mbit_s": "service sent",
        "down_arrived_mbit_s": "arrived",
    }
    return beside_thesis(rows, shown, THESIS, "Network, medians over the seconds, beside section 5.5.3")
