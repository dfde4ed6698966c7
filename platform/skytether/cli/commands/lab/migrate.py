"""``skytether lab bench migrate``: moves of a service under a driven robot."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.table import Table

from skytether.lab.bench.pair import BenchError
from skytether.lab.embedded import EmbeddedError

from ...output import console, fail, print_json


def migrate(
    n: Annotated[int, typer.Option("-n", min=1, max=1000, help="Moves.")] = 10,
    json: Annotated[bool, typer.Option("--json", help="Print one row.")] = False,
) -> None:
    """Move a service from one site to another under a driven robot: the longest time without a command.

    Beside it, the same while nothing happens, and around the start of another program of the service's size.
    """
    from skytether.lab.bench.migrate import bench_migrate

    try:
        with console.status("starting ...") as line:
            row = bench_migrate(n, lambda i, gap: line.update(f"move {i + 1} of {n}: {gap:.1f} ms"))
    except (BenchError, EmbeddedError) as error:
        fail(str(error))
    if json:
        print_json(row.document())
        return
    table = Table(title="Longest gap between commands when a service moves")
    for heading in ("", "p50 [ms]", "max [ms]"):
        table.add_column(heading, justify="right")
    table.add_row("around a move", f"{row.gap_p50_ms:.1f}", f"{row.gap_max_ms:.1f}")
    table.add_row("around the start of another program", f"{row.gap_start_p50_ms:.1f}", f"{row.gap_start_max_ms:.1f}")
    table.add_row("without a move", f"{row.gap_still_p50_ms:.1f}", f"{row.gap_still_max_ms:.1f}")
    console.print(table)
    console.print(
        f"{row.n} moves, {row.move_p50_s:.2f} s each, {row.fallbacks} with the robot's own controller in between; "
        f"two periods are {row.bound_ms:g} ms"
    )
