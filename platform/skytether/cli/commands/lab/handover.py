"""``skytether lab scenario handover``: a change of network in mid-stream."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.table import Table

from skytether.bridge import BridgeError
from skytether.lab.handover import VARIANTS, HandoverError
from skytether.lab.handover import handover as run

from ...output import console, fail, print_json


def handover(
    variant: Annotated[
        list[str] | None, typer.Option(help="planned, redundant or failover; may be repeated. Default: all three.")
    ] = None,
    seconds: Annotated[float, typer.Option(min=1, max=3600, help="Length of each run.")] = 20,
    at: Annotated[float, typer.Option(min=0.5, help="Time of the hand-over, in seconds.")] = 10,
    json: Annotated[bool, typer.Option("--json", help="Print a list of rows, one for each direction.")] = False,
) -> None:
    """Change from one network to another in mid-stream: 128 bytes every 10 ms, both ways (thesis, section 3.5).

    planned: the other network is preferred, then the first is cut. redundant: the first is cut without notice while
    messages go by both. failover: it is cut without notice while they go by one.
    """
    rows = []
    try:
        for name in variant or VARIANTS:
            with console.status(f"{name}: {seconds:g} s ..."):
                rows += run(name, seconds=seconds, at=at)
    except ValueError as error:
        fail(str(error), 2)
    except (BridgeError, HandoverError, OSError) as error:
        fail(str(error))
    if json:
        print_json([row.document() for row in rows])
        return
    table = Table("variant", "direction", "sent", "lost", "longest gap [ms]", "delay p50 [ms]", title="Hand-over")
    for row in rows:
        table.add_row(
            row.variant, row.direction, str(row.sent), str(row.lost), f"{row.gap_max_ms:.1f}", f"{row.delay_p50_ms:.1f}"
        )
    console.print(table)
