"""``skytether lab bench mapping``, ``localisation`` and ``navigation``: the service ``navigation`` is measured."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from skytether.lab.bench.mapping import ODOMETRY, bench_mapping
from skytether.lab.bench.navigation import NavigationBenchError, bench_driving, bench_localisation
from skytether.lab.carmen import CarmenError, read_log
from skytether.lab.world.plan import PlanError, building, read_plan

from ...output import console, fail, print_json

_Log = Annotated[
    Path, typer.Argument(help="CARMEN log (FLASER, ODOM), plain or .gz.", exists=True, dir_okay=False, readable=True)
]
_Fov = Annotated[
    float | None,
    typer.Option(min=1, max=360, help="Field of view in degrees. Default: by the number of rays; 180 mostly."),
]
_Seed = Annotated[int, typer.Option(min=0, help="The first seed of the odometry's noise.")]
_Seeds = Annotated[int, typer.Option(min=1, max=1000, help="Runs, each with the next seed.")]
_Json = Annotated[bool, typer.Option("--json", help="It is JSON without it, too.")]


def mapping(
    log: _Log,
    relations: Annotated[
        Path | None,
        typer.Option(help="Official relations of the log, to judge by.", exists=True, dir_okay=False, readable=True),
    ] = None,
    stamp_offset: Annotated[
        float, typer.Option(help="Seconds added to the relations' stamps to have the log's.")
    ] = 0.0,
    seed: _Seed = 1,
    seeds: _Seeds = 1,
    odometry: Annotated[
        str,
        typer.Option(
            help="noisy: the log's, with 0.1 m/m and 0.1 rad/rad added; recorded: the log's as it is; laser: none."
        ),
    ] = "noisy",
    fov: _Fov = None,
    save: Annotated[
        Path | None, typer.Option(help="Write the first seed's map: this YAML file, PGM and PNG beside it.")
    ] = None,
    json: _Json = False,  # noqa: ARG001
) -> None:
    """Build a map of a recorded log with the service navigation, and judge it by official relations.

    Prints one JSON object: mean and standard deviation of the relations' errors (means over the seeds), of all, and of
    neighbours (within 10 s) and loops apart; wall_s with reading the log, peak_mb of the whole process.
    """
    mode = next((known for known in ODOMETRY if known == odometry), None)
    if mode is None:
        fail(f"--odometry is one of {', '.join(ODOMETRY)}, not '{odometry}'", 2)
    try:
        with console.status("reading ...") as line:
            document = bench_mapping(
                log,
                relations,
                stamp_offset=stamp_offset,
                fov=None if fov is None else math.radians(fov),
                odometry=mode,
                seeds=range(seed, seed + seeds),
                save=save,
                progress=line.update,
            )
    except (CarmenError, NavigationBenchError, OSError) as error:
        fail(str(error))
    print_json(document)


def localisation(
    log: _Log,
    seed: _Seed = 1,
    seeds: _Seeds = 1,
    starts: Annotated[
        int, typer.Option(min=0, max=1000, help="So many times the robot is to be found without a first pose.")
    ] = 0,
    kidnaps: Annotated[int, typer.Option(min=0, max=1000, help="So many times it is carried away.")] = 0,
    fov: _Fov = None,
    json: _Json = False,  # noqa: ARG001
) -> None:
    """Map the first 60 % of a corrected log, and find the robot in the rest, with noise on its odometry.

    Prints one JSON object; its mean and 95th percentile of the position's error are over all seeds.
    """
    try:
        with console.status("reading ...") as line:
            recorded = read_log(log, fov=None if fov is None else math.radians(fov))
            document = bench_localisation(
                recorded, range(seed, seed + seeds), line.update, starts=starts, kidnaps=kidnaps
            )
    except (CarmenError, NavigationBenchError, OSError) as error:
        fail(str(error))
    print_json(document)


def navigation(
    trajectories: Annotated[
        int, typer.Option(min=10, max=20_000, help="That the controller tries in each step.")
    ] = 1000,
    goals: Annotated[
        int | None, typer.Option(min=1, help="So many of the goals; the building has nine. Default: all.")
    ] = None,
    delays: Annotated[
        bool, typer.Option("--delays", help="Instead: over links of more and more delay, with each compensation.")
    ] = False,
    plan: Annotated[
        Path | None,
        typer.Option(
            help="With --delays: a plan of your own (YAML) instead of the building.",
            exists=True,
            dir_okay=False,
            readable=True,
        ),
    ] = None,
    jitter_only: Annotated[
        bool,
        typer.Option(
            "--jitter-only", help="With --delays: only the link with jitter and loss, and measured without delay."
        ),
    ] = False,
    cluttered: Annotated[
        int | None, typer.Option(min=1, max=1000, help="Instead: through so many fields of cylinders.")
    ] = None,
    runs: Annotated[
        int | None,
        typer.Option(min=1, max=1000, help="In each field (10), or over each link with each compensation (1)."),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the world's noise, of links and fields.")] = 1,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object for programs.")] = False,
) -> None:
    """Drive the service navigation through the simulated building, and time each step of its loop of 30 Hz.

    A step is all that the service does in one: localisation, costmaps, planner, controller, messages. Time is made up,
    so nothing waits; compilation comes before, and is told apart. By the clock, and of the processor.
    """
    if delays and cluttered is not None:
        fail("--delays and --cluttered are two benchmarks; give one of them", 2)
    if not delays and (plan is not None or jitter_only):
        fail(f"{'--plan' if plan is not None else '--jitter-only'} is for --delays; give it, too", 2)
    try:
        world = read_plan(plan) if plan is not None else building()
    except (PlanError, OSError) as error:
        fail(str(error), 2)
    goals = goals or len(world.goals)
    if goals > len(world.goals):
        fail(f"--goals {goals} is too many: the plan '{world.name}' has {len(world.goals)}", 2)
    try:
        with console.status("loading ...") as line:
            if delays:
                found = bench_driving(
                    "navigation-delays",
                    plan=world,
                    goals=goals,
                    runs=runs or 1,
                    seed=seed,
                    jitter_only=jitter_only,
                    progress=line.update,
                )
            elif cluttered is not None:
                found = bench_driving(
                    "navigation-cluttered", worlds=cluttered, runs=runs or 10, seed=seed, progress=line.update
                )
            else:
                found = bench_driving(
                    "navigation", trajectories=trajectories, goals=goals, seed=seed, progress=line.update
                )
    except NavigationBenchError as error:
        fail(str(error))
    if json:
        print_json(found)
    elif delays:
        _print_delays(found)
    elif cluttered is not None:
        _print_cluttered(found)
    else:
        _print_steps(found)


def _print_steps(found: dict[str, Any]) -> None:

    table = Table("ms per step", "p50", "p99", "max")
    for name, text in (("wall", "by the clock"), ("cpu", "of the processor")):
        table.add_row(text, *(f"{found[f'{name}_{part}_ms']:.2f}" for part in ("p50", "p99", "max")))
    console.print(table)
    console.print(
        f"{found['steps']} steps, {found['trajectories']} trajectories of {found['trajectory_steps']} steps; "
        f"{found['state']} after {found['driven_s']} s and {found['driven_m']} m, {found['contacts']} contacts; "
        f"compilation and warm-up {found['warm_up_s']} s.",
        highlight=False,
    )
    verdict = "within" if found["within_bar"] else "not within"
    console.print(f"p99 by the clock is {verdict} {found['bar_p99_ms']:g} ms.", highlight=False)


def _print_delays(found: dict[str, Any]) -> None:

    table = Table(
        "round trip",
        "jitter",
        "loss",
        "told",
        "compensation",
        "ended",
        "time",
        "path error",
        "prediction",
        "across",
        "contacts",
    )
    for row in found["rows"]:
        table.add_row(
            f"{1000 * row['round_trip']:.0f} ms",
            f"{1000 * row['jitter']:.0f} ms",
            f"{100 * row['loss']:g} %",
            f"{1000 * row['told']:.0f} ms" if row["compensation"] == "fixed" else "",
            row["compensation"],
            row["state"],
            _with_std(row, "seconds", 1, "s"),
            *(_with_std(row, error, 1000, "mm") for error in ("path_error", "prediction_error", "prediction_across")),
            str(row["contacts"]),
        )
    console.print(table)
    for test in found["fixed_against_measured"]:
        link = ", ".join(f"{name} {1000 * test[key]:.0f} ms" for name, key in _LINK)
        console.print(
            f"{link}: {test['error']} of fixed less measured, {test['test']} by seed: "
            f"{1000 * test['difference']:.2f} mm, {1000 * test['low']:.2f} to {1000 * test['high']:.2f} (95 %): "
            f"t = {test['t']}, p = {test['p']:.2g}.",
            highlight=False,
        )
    for name, text in (
        ("time_within_bar", "At the longest round trip within 5 % of the time without delay"),
        (
            "measured_beats_fixed",
            "With jitter and loss measured predicts the robot's place better than fixed, along its way and across",
        ),
        ("measured_halves_off", "and leaves at most half the path error of none"),
    ):
        if name in found:
            console.print(f"{text}: {'yes' if found[name] else 'no'}.", highlight=False)


_LINK = (("round trip", "round_trip"), ("jitter", "jitter"), ("told", "told"))


def _with_std(row: dict[str, Any], name: str, scale: float, unit: str) -> str:
    std = row[f"{name}_std"]
    return f"{scale * row[name]:.1f}{'' if std is None else f' ± {scale * std:.1f}'} {unit}"


def _print_cluttered(found: dict[str, Any]) -> None:
    console.print(
        f"{found['worlds']} fields of our own generator, {found['runs']} runs in each: "
        f"{100 * found['success']:.1f} % without contact at the goal, score {found['score']:.3f} (not a BARN score).",
        highlight=False,
    )
    console.print(f"95 % and 0.44 are {'met' if found['within_bar'] else 'not met'}.", highlight=False)
