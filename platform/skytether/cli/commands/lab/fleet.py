"""``skytether lab bench fleet``: what a disturbed fleet counted, and its orchestrator."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.table import Table

from skytether.lab.bench.fleet import bench_fleet
from skytether.lab.bench.pair import BenchError
from skytether.lab.embedded import EmbeddedError

from ...output import console, fail, print_json, silenced


def fleet(
    robots: Annotated[int, typer.Option(min=6, max=1000, help="Of the fleet, each with its instance.")] = 100,
    seconds: Annotated[float, typer.Option(min=4, max=3600, help="Of traffic, in made-up time.")] = 20,
    json: Annotated[bool, typer.Option("--json", help="Print one row.")] = False,
) -> None:
    """Disturb a fleet in every way, and compare what it counted with what its orchestrator exports.

    100 robots take some minutes: both ends of each bridge are real, the link between them is made up.
    """
    try:
        with silenced("skytether.robot"), console.status("starting ...") as line:
            row = bench_fleet(robots, seconds, line.update)
    except (BenchError, EmbeddedError) as error:
        fail(str(error))
    if json:
        print_json(row.document())
    else:
        table = Table("", "measured", title=f"{row.robots} robots, {row.seconds:g} s of traffic each")
        table.add_row("messages sent", f"{row.messages:,}")
        table.add_row("lost in accounting", str(row.lost_in_accounting))
        table.add_row("delivered otherwise than told", str(row.miscounted))
        table.add_row("counters that went down", str(row.fallen))
        table.add_row("series of robots that had gone", str(row.left_over))
        table.add_row("renewals, p50 / p99", f"{row.renewals}, {row.renew_p50_ms:.1f} / {row.renew_p99_ms:.1f} ms")
        table.add_row("cores that the orchestrator kept busy", f"{row.cpu:.2f}")
        table.add_row("memory of the orchestrator", f"{row.memory_mb:.0f} MiB")
        table.add_row("one look at /metrics", f"{row.scrape_ms:.0f} ms, {row.metrics_kb:.0f} KiB")
        console.print(table)
    if row.lost_in_accounting or row.miscounted or row.fallen or row.left_over:
        fail("the orchestrator's books do not balance")
