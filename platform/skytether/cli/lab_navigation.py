"""``skytether lab bench mapping`` and ``localisation``: the service ``navigation`` on recorded logs."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from .output import console, fail, print_json

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
    from skytether.lab.bench.mapping import ODOMETRY, bench_mapping
    from skytether.lab.bench.navigation import NavigationBenchError
    from skytether.lab.carmen import CarmenError

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
    from skytether.lab.bench.navigation import NavigationBenchError, bench_localisation
    from skytether.lab.carmen import CarmenError, read_log

    try:
        with console.status("reading ...") as line:
            recorded = read_log(log, fov=None if fov is None else math.radians(fov))
            document = bench_localisation(
                recorded, range(seed, seed + seeds), line.update, starts=starts, kidnaps=kidnaps
            )
    except (CarmenError, NavigationBenchError, OSError) as error:
        fail(str(error))
    print_json(document)
