"""``skytether lab bench face``: where rendered faces point."""

from __future__ import annotations

import math
from typing import Annotated

import typer

from skytether.lab.bench.navigation import NavigationBenchError
from skytether.lab.world.model import WorldError

from ...output import console, fail, print_json


def face(
    distance: Annotated[
        list[float] | None,
        typer.Option(min=0.5, max=3, help="Of the face from the camera [m]; may be repeated. Default: 0.9, 1.4."),
    ] = None,
    degrees: Annotated[float, typer.Option(min=1, max=60, help="How far the head turns to each side.")] = 40,
    seeds: Annotated[int, typer.Option(min=1, max=1000, help="Runs at each distance: other walls, other noise.")] = 3,
    json: Annotated[bool, typer.Option("--json", help="It is JSON without it, too.")] = False,  # noqa: ARG001
) -> None:
    """Look at a head that turns from side to side, with the service follow-in-front's eyes.

    The head is rendered as the simulated robot's camera sees it, 640 x 480 pixels, and coded as JPEG. Prints one JSON
    object: share of pictures in which it was detected, errors of its angle, times. Rendered faces are easier than
    photographs.
    """
    from skytether.lab.bench.face import bench_face

    try:
        with console.status("drawing and looking ..."):
            document = bench_face(distance or (0.9, 1.4), math.radians(degrees), range(1, seeds + 1))
    except (NavigationBenchError, WorldError) as error:
        fail(str(error))
    print_json(document)
