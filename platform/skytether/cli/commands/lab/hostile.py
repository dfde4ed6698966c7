"""``skytether lab bench hostile``: what the others notice of one hostile robot."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.table import Table

from skytether.lab.bench.hostile import bench_hostile
from skytether.lab.bench.pair import BenchError
from skytether.lab.embedded import EmbeddedError

from ...output import console, fail, print_json


def hostile(
    robots: Annotated[int, typer.Option(min=2, max=1000, help="One of them is hostile.")] = 100,
    minutes: Annotated[float, typer.Option(min=0.05, max=1440, help="Of attack; 60: an hour.")] = 2,
    json: Annotated[bool, typer.Option("--json", help="Print one row.")] = False,
) -> None:
    """Let one robot of a fleet attack the orchestrator with all it can, all at once, and look after the others.

    Ends with exit status 1 if an instance of the others ended, or a renewal of theirs got no good answer.
    """
    try:
        with console.status("starting ...") as line:
            row = bench_hostile(robots, minutes, line.update)
    except (BenchError, EmbeddedError) as error:
        fail(str(error))
    if json:
        print_json(row.document())
    else:
        table = Table("", "measured", title=f"{row.robots} robots, one of them hostile for {row.minutes:g} min")
        table.add_row("renewals of the others, p50 / p99", f"{row.renew_p50_ms:.1f} / {row.renew_p99_ms:.1f} ms")
        table.add_row("the same at the orchestrator, p99", f"{row.served_p99_ms:.1f} ms")
        table.add_row("the same before, p99", f"{row.quiet_p99_ms:.1f} ms")
        table.add_row("without a good answer", f"{row.failed} of {row.renewals}")
        table.add_row("instances of the others that ended", str(row.ended_wrongly))
        table.add_row("memory of the orchestrator, growth", f"{row.memory_mb:.0f} MiB, {row.memory_growth_mb:+.1f} MiB")
        table.add_row("its state folder's growth", f"{row.state_growth_mb:+.2f} MiB")
        table.add_row("attacks, refused", f"{row.attacks:,}, {row.refused:,}")
        for kind, statuses in row.answers.items():
            table.add_row(f"  {kind}", ", ".join(f"{status or 'closed'}: {n:,}" for status, n in statuses.items()))
        console.print(table)
    if row.ended_wrongly or row.failed:
        fail("the others noticed")
