"""``skytether lab bench legs``: people are tracked by their legs in a recording."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from skytether.lab.bench.legs import bench_legs
from skytether.lab.bench.navigation import NavigationBenchError
from skytether.robot.replay.bag import BagError

from ...output import console, fail, print_json


def legs(
    bag: Annotated[
        Path, typer.Argument(help="ROS 1 bag (or a ZIP file of one), ROS 2 bag or MCAP file with scans.", exists=True)
    ],
    topic: Annotated[str | None, typer.Option(help="Of the scans. Default: the only one there is, or /scan.")] = None,
    angles: Annotated[
        tuple[float, float] | None,
        typer.Option(help="Judge between these angles of the laser, in degrees. Default: where people were annotated."),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="It is JSON without it, too.")] = False,  # noqa: ARG001
) -> None:
    """Track people by their legs in a recording, with the service follow-in-front's eyes.

    Prints one JSON object: legs found in a scan, tracks, times. Where the recording says who was where
    (/ground_truth_people_tracks), also CLEAR MOT; else a track that begins where one has just ended counts as a switch,
    and a scan that shows nothing of somebody as a miss (judged_by).
    """
    try:
        with console.status("reading ..."):
            document = bench_legs(bag, topic, angles)
    except (BagError, NavigationBenchError, OSError) as error:
        fail(str(error))
    print_json(document)
