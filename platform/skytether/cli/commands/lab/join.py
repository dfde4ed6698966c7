"""``skytether lab bench join``: from an engine to a site that drives a robot."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.table import Table

from skytether.lab.bench.pair import BenchError
from skytether.lab.embedded import EmbeddedError

from ...output import console, fail, print_json


def join(
    prefix: Annotated[str, typer.Option(help="Of the images' names, which the engine has.")] = "skytether/",
    json: Annotated[bool, typer.Option("--json", help="Print rows `step, took_s`.")] = False,
) -> None:
    """Time from a machine that has nothing but a Docker engine to a robot that is driven from there, by step.

    This machine's engine joins an orchestrator that is started for it; a robot asks for virtual-trail.
    """
    from skytether.lab.bench.join import bench_join

    try:
        with console.status("starting ...") as line:
            rows = bench_join(prefix, line.update)
    except (BenchError, EmbeddedError) as error:
        fail(str(error))
    if json:
        print_json([row.document() for row in rows])
        return
    table = Table("step", "took [s]", title="From an engine to the first velocity command")
    for row in rows:
        table.add_row(row.step, f"{row.took_s:.3f}")
    console.print(table)
