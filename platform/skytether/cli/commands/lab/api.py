"""``skytether lab bench api``: an orchestrator that runs many instances."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.table import Table

from skytether.lab.bench.api import bench_api
from skytether.lab.bench.pair import BenchError
from skytether.lab.embedded import EmbeddedError

from ...output import console, fail, print_json


def api(
    instances: Annotated[int, typer.Option(min=1, max=2000, help="Sleeping instances that run meanwhile.")] = 200,
    rate: Annotated[float, typer.Option(min=1, max=10_000, help="Requests a second.")] = 100,
    seconds: Annotated[float, typer.Option(min=1, max=600, help="For how long.")] = 20,
    json: Annotated[bool, typer.Option("--json", help="Print one row.")] = False,
) -> None:
    """Ask an orchestrator that runs many instances: its answers, its reconcile passes, its memory."""
    try:
        with console.status("starting ...") as line:
            row = bench_api(instances, rate, seconds, line.update)
    except (BenchError, EmbeddedError) as error:
        fail(str(error))
    if json:
        print_json(row.document())
        return
    table = Table("", "measured", title=f"{row.instances} instances, {row.rate_hz:g} requests a second")
    table.add_row("answers, p50 / p99", f"{row.api_p50_ms:.1f} / {row.api_p99_ms:.1f} ms")
    for kind, spread in row.kinds.items():
        table.add_row(f"  {kind}", f"{spread.p50_ms:.1f} / {spread.p99_ms:.1f} ms")
    table.add_row("the client by itself, p50 / p99", f"{row.client_p50_ms:.1f} / {row.client_p99_ms:.1f} ms")
    table.add_row("requests without a good answer", f"{row.failed} of {row.requests}")
    table.add_row("reconcile pass, p50 / slowest", f"{row.pass_p50_ms:.1f} / {row.pass_max_ms:.1f} ms")
    table.add_row("slowest pass of the placer", f"{row.placer_max_ms:.1f} ms")
    table.add_row("cores busy before / meanwhile", f"{row.cpu_idle:.2f} / {row.cpu:.2f}")
    table.add_row("memory of the orchestrator", f"{row.memory_mb:.0f} MiB")
    table.add_row("instances lost or doubled", str(row.lost))
    table.add_row("all started within", f"{row.start_s:.1f} s")
    console.print(table)
