"""``skytether lab bench start``: from a request to the first command."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.table import Table

from skytether.lab.bench.pair import BenchError
from skytether.lab.embedded import EmbeddedError

from ...output import console, fail, print_json


def start(
    n: Annotated[int, typer.Option("-n", min=1, max=1000, help="Starts to measure.")] = 20,
    runtime: Annotated[
        list[str] | None, typer.Option(help="process, docker or kubernetes; may be repeated. Default: process.")
    ] = None,
    service: Annotated[str, typer.Option(help="virtual-trail, or navigation (extra `lab`).")] = "virtual-trail",
    prefix: Annotated[str, typer.Option(help="Of the images' names.")] = "skytether/",
    json: Annotated[
        bool,
        typer.Option("--json", help="Print rows `runtime, standby, p50_s, p99_s, n, moving_p50_s, moving_p99_s`."),
    ] = False,
) -> None:
    """Time from a robot's request over REST to the first velocity command that it accepts.

    With navigation also to the first that moves the robot: on its way to a goal, on a map that it gives the service.

    With docker, the images must be there (`make images`), and `docker run` of the same image is timed in turn, until
    its service listens; each after three seconds of rest.

    With kubernetes, the nodes of the cluster of KUBECONFIG have the images; pods are in a namespace that is removed.
    """
    from skytether.lab.bench.start import bench_start

    try:
        with console.status("starting ...") as line:
            rows = bench_start(
                n, runtime or ["process"], prefix, lambda row, s: line.update(f"{row}: {s:.3f} s"), service
            )
    except (BenchError, EmbeddedError) as error:
        fail(str(error))
    if json:
        print_json([row.document() for row in rows])
        return
    moves = any(row.moving_p50_s is not None for row in rows)
    more = ("moving p50 [s]", "moving p99 [s]") if moves else ()
    title = "Request to first velocity command"
    table = Table("runtime", "standby", "p50 [s]", "p99 [s]", *more, "starts", title=title)
    for row in rows:
        times = (row.p50_s, row.p99_s, *((row.moving_p50_s, row.moving_p99_s) if moves else ()))
        shown = ("" if time is None else f"{time:.3f}" for time in times)
        table.add_row(row.runtime, str(row.standby), *shown, str(row.n))
    console.print(table)
