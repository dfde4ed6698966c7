"""``skytether lab``: experiments and benchmarks."""

from __future__ import annotations

from typing import Annotated

import typer

from .output import console, fail, print_json

app = typer.Typer(help="Experiments and benchmarks on this machine.", no_args_is_help=True)
bench = typer.Typer(help="Measure the real program, and print what was measured.", no_args_is_help=True)
app.add_typer(bench, name="bench")


@bench.command("start")
def start(
    n: Annotated[int, typer.Option("-n", min=1, max=1000, help="Starts to measure.")] = 20,
    json: Annotated[bool, typer.Option("--json", help="Print rows `runtime, standby, p50_s, p99_s, n`.")] = False,
) -> None:
    """Time from a robot's request over REST to the first velocity command that it accepts."""
    from rich.table import Table

    from skytether.lab.bench.start import BenchError, bench_start
    from skytether.lab.embedded import EmbeddedError

    try:
        with console.status("starting ...") as line:
            rows = bench_start(n, lambda i, s: line.update(f"start {i + 1} of {n}: {s:.3f} s"))
    except (BenchError, EmbeddedError) as error:
        fail(str(error))
    if json:
        print_json([row.document() for row in rows])
        return
    table = Table("runtime", "standby", "p50 [s]", "p99 [s]", "starts", title="Request to first velocity command")
    for row in rows:
        table.add_row(row.runtime, str(row.standby), f"{row.p50_s:.3f}", f"{row.p99_s:.3f}", str(row.n))
    console.print(table)
