"""``skytether lab bench resize``: commands of a service while it is given more, or less."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.table import Table

from skytether.lab.bench.pair import BenchError
from skytether.lab.embedded import EmbeddedError

from ...output import console, fail, print_json


def resize(
    n: Annotated[int, typer.Option("-n", min=1, max=1000, help="Changes.")] = 10,
    runtime: Annotated[str, typer.Option(help="docker, or process, which holds nothing to its size.")] = "docker",
    prefix: Annotated[str, typer.Option(help="Of the images' names.")] = "skytether/",
    json: Annotated[bool, typer.Option("--json", help="Print one row.")] = False,
) -> None:
    """Give a driven robot's instance more cores and memory, and less, under load: the longest time without a command.

    Beside it, the same over as long a time without a change. With docker, the images must be there (`make images`).
    """
    from skytether.lab.bench.resize import SIZES, bench_resize

    try:
        with console.status("starting ...") as line:
            row = bench_resize(n, runtime, prefix, lambda i, gap: line.update(f"change {i + 1} of {n}: {gap:.1f} ms"))
    except (BenchError, EmbeddedError) as error:
        fail(str(error))
    if json:
        print_json(row.document())
        return
    table = Table(title=f"Longest gap between commands, in periods: {SIZES[1]}, {SIZES[0]} in turn ({row.runtime})")
    for heading in ("", "p50", "max", "over two periods"):
        table.add_column(heading, justify="right")
    of = f"of {row.n}"
    table.add_row("around a change", f"{row.gap_p50_periods:.2f}", f"{row.gap_max_periods:.2f}", f"{row.over} {of}")
    table.add_row(
        "without one",
        f"{row.gap_still_p50_periods:.2f}",
        f"{row.gap_still_max_periods:.2f}",
        f"{row.over_still} {of}",
    )
    console.print(table)
    console.print(
        f"{row.n} changes, {row.resize_p50_s:.2f} s each, {row.fallbacks} with the robot's own controller in between; "
        f"the instance was restarted {row.restarts} times"
    )
