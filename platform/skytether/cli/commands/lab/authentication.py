"""``skytether lab bench authentication``: what it costs that each packet is authentic."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.table import Table

from skytether.lab.bench.authentication import bench_authentication
from skytether.lab.bench.pair import BenchError

from ...output import console, fail, print_json


def authentication(
    n: Annotated[int, typer.Option("-n", min=1, max=10_000, help="Messages of each size.")] = 100,
    json: Annotated[
        bool,
        typer.Option(
            "--json",
            help="Print rows `size, packets, n, sender_us, sender_tags_us, receiver_us, receiver_tags_us`.",
        ),
    ] = False,
) -> None:
    """Processor time of a message at both ends of the bridge, without sockets, and how much of it the tags take."""
    try:
        rows = bench_authentication(n)
    except BenchError as error:
        fail(str(error))
    if json:
        print_json([row.document() for row in rows])
        return
    table = Table(title=f"Processor time of a message, the least of {n}")
    for heading in ("message [B]", "packets", "sender [us]", "of it tags", "receiver [us]", "of it tags"):
        table.add_column(heading, justify="right")
    for row in rows:
        table.add_row(
            f"{row.size:,}",
            str(row.packets),
            f"{row.sender_us:,.0f}",
            f"{row.sender_tags_us:,.1f} ({row.sender_tags_us / row.sender_us:.0%})",
            f"{row.receiver_us:,.0f}",
            f"{row.receiver_tags_us:,.1f} ({row.receiver_tags_us / row.receiver_us:.0%})",
        )
    console.print(table)
