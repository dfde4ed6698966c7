"""``skytether lab bench safety``: the promises of docs/safety.md, attacked on real processes, suspend rehearsed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from skytether.lab.bench.ros2_node import check_python
from skytether.lab.bench.safety import HEADING, bench_safety, estimate, select
from skytether.lab.bench.transports.base import TransportError
from skytether.lab.safety.ros1_hardware import available

from ...output import console, fail, print_json

if TYPE_CHECKING:
    from skytether.lab.bench.safety import SafetyRow


def safety(
    attack: Annotated[
        list[str] | None,
        typer.Option(help="Name of an attack, or what several names begin with; may be repeated. Default: all."),
    ] = None,
    n: Annotated[int, typer.Option("-n", min=1, max=1000, help="How often each is staged.")] = 1,
    busy: Annotated[bool, typer.Option("--busy", help="Other programs take all cores meanwhile.")] = False,
    ros1: Annotated[
        bool, typer.Option("--ros1", help="Attacks on a robot that is a ROS 1 graph, too; needs rosmaster.")
    ] = False,
    ros2: Annotated[
        bool, typer.Option("--ros2", help="Attacks on a robot that is a ROS 2 graph, too; needs rclpy.")
    ] = False,
    json: Annotated[bool, typer.Option("--json", help="Print a list of rows, one for each attack.")] = False,
    markdown: Annotated[bool, typer.Option("--markdown", help="Print the table of docs/safety-attacks.md.")] = False,
) -> None:
    """Attack the robot's gate on real processes, and hold what the wheels received against what is promised.

    Guard, gate and agent are real; sensors and wheels are played.
    Only 'suspend' is rehearsed without processes, with a made-up clock.
    Ends with exit status 1 if a promise was broken.
    """
    if ros1 and not available():
        fail("there is no program 'rosmaster': install ros-core, or leave out --ros1", 2)
    if ros2:
        try:
            check_python()
        except TransportError as error:
            fail(str(error), 2)
    try:
        chosen = select(attack or (), ros1, ros2)
    except ValueError as error:
        fail(str(error), 2)
    console.print(f"{len(chosen)} attacks, about {estimate(chosen, n) / 60:.1f} minutes", style="dim", markup=False)
    rows = []
    try:
        with console.status("starting ...") as line:
            rows = list(bench_safety(chosen, n, busy, line.update))
    except OSError as error:
        fail(str(error))
    if json:
        print_json([row.document() for row in rows])
    elif markdown:
        print(HEADING, *(row.line(known.what) for row, known in zip(rows, chosen, strict=True)), sep="\n")
    else:
        _show(rows)
    broken = [row for row in rows if row.violations]
    for row in broken if not json else ():
        for text in row.what:
            console.print(f"{row.attack}: {text}", markup=False, style="red", highlight=False, soft_wrap=True)
    if broken:
        fail(f"promises were broken in {len(broken)} of {len(rows)} attacks")


def _show(rows: list[SafetyRow]) -> None:

    table = Table(title="Attacks on the gate")
    table.add_column("attack", no_wrap=True)
    for heading in ("n", "violations", "max [m/s]", "max [m/s²]", "stands [s]", "promised"):
        table.add_column(heading, justify="right")
    for row in rows:
        table.add_row(
            row.attack,
            str(row.n),
            str(row.violations),
            f"{row.velocity_max_m_s:.2f}",
            f"{row.acceleration_max_m_s2:.2f}",
            "" if row.standstill_max_s is None else f"{row.standstill_max_s:.2f}",
            "" if row.promised_s is None else f"{row.promised_s:.2f}",
        )
    console.print(table)
