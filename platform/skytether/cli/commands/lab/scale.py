"""``skytether lab bench scale``: how far an orchestrator goes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from skytether.lab.bench.pair import BenchError
from skytether.lab.bench.scale import bench_scale
from skytether.lab.embedded import EmbeddedError

from ...output import console, fail, print_json

_LEVELS = (100, 300, 1000, 3000, 10_000)


def scale(
    robots: Annotated[int, typer.Option(min=10, max=100_000, help="Instances at last, one for each robot.")] = 1000,
    placements: Annotated[int, typer.Option(min=10, max=100_000, help="Robots that wait for room at once.")] = 1000,
    calls: Annotated[float, typer.Option(min=1, help="Calls a second beyond which the API server refuses.")] = 400,
    replicas: Annotated[int, typer.Option(min=1, max=9, help="Orchestrators; several need --database.")] = 1,
    database: Annotated[
        str | None, typer.Option(metavar="URL", help="PostgreSQL with an empty database, instead of SQLite.")
    ] = None,
    plot: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write a PNG of the costs over the number of instances.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print one document.")] = False,
) -> None:
    """Thousands of instances at a Kubernetes site whose API server is made up: what they cost, how long robots wait.

    10,000 robots take half an hour. The orchestrator is real, and so are its calls; what is made up is the cluster.
    """
    if replicas > 1 and database is None:
        raise typer.BadParameter("several orchestrators need one database: give --database postgresql://USER@HOST/NAME")
    if plot is not None and not plot.parent.is_dir():
        raise typer.BadParameter(f"there is no folder {plot.parent}")
    levels = [*(level for level in _LEVELS if level < robots), robots]
    try:
        with console.status("starting ...") as line:
            found = bench_scale(
                levels, placements, calls, on_progress=line.update, replicas=replicas, database=database
            )
    except (BenchError, EmbeddedError) as error:
        fail(str(error))
    if plot is not None:
        from skytether.lab.bench.scale_plot import plot_scale

        plot_scale(found, plot)
    if json:
        print_json(found.document())
        return
    table = Table("instances", title="An orchestrator and a cluster that is made up")
    for heading in (
        "pass [ms]",
        "each [us]",
        "placer [ms]",
        "cores",
        "MiB",
        "calls/s",
        "most",
        "renew [ms]",
        "cold [s]",
        "warm [s]",
    ):
        table.add_column(heading, justify="right")
    for row in found.rows:
        table.add_row(
            f"{row.instances:,}",
            f"{row.pass_ms:.0f}",
            f"{row.pass_us_each:.0f}",
            f"{row.placer_ms:.0f}",
            f"{row.cpu:.2f}",
            f"{row.memory_mb:.0f}",
            f"{row.calls_per_s:.0f}",
            f"{row.most_calls_per_s}",
            f"{row.renew_p50_ms:.0f} / {row.renew_p99_ms:.0f}",
            f"{row.cold_p50_s:.2f} / {row.cold_p99_s:.2f}",
            f"{row.warm_p50_s:.2f} / {row.warm_p99_s:.2f}",
        )
    console.print(table)
    console.print(
        f"{found.placements:,} robots that waited were given a site at {found.placements_per_s:.0f} a second; an "
        f"instance takes {found.memory_kb_each:.0f} KiB; {found.refused_calls} calls were refused. Times are p50 / p99."
    )
