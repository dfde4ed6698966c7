"""``skytether lab bench ros``: what Skytether adds to a message of ROS 2."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.box import SIMPLE_HEAD
from rich.table import Table

from skytether.lab.bench.pair import BenchError
from skytether.lab.bench.ros import BRIDGED, PLAIN, bench_ros

from ...output import console, fail, print_json


def ros(
    seconds: Annotated[float, typer.Option(min=0.5, max=3600, help="For each kind of message, each way.")] = 10.0,
    way: Annotated[
        list[str] | None, typer.Option(help="plain or skytether; may be repeated. Default: one after the other.")
    ] = None,
    json: Annotated[
        bool,
        typer.Option(
            "--json",
            help="Print rows `message, way, hz, sent, delivered, p50_ms, p99_ms, max_ms, nodes_us, robot_us, "
            "service_us, nodes_rest, ends_rest`: processor time of a message in the two nodes and in each end of the "
            "bridge, beyond what they take at rest; shares of a core at rest.",
        ),
    ] = False,
) -> None:
    """A talker and a listener of ROS 2 as they are, and with Skytether between: delays, processor time.

    A velocity (Twist, 100 Hz), a scan of 541 rays (40 Hz) and a picture of
    47 kB (15 Hz), made and decoded by nodes of rclpy on this machine. With
    Skytether between them each node has a domain of its own, and two
    `skytether bridge` join the domains over loopback.

    ROS 2 is that of `make ros2`, or of the Python that
    SKYTETHER_ROS2_PYTHON names.
    """
    ways = (PLAIN, BRIDGED)
    unknown = [name for name in way or () if name not in ways]
    if unknown:
        fail(f"way '{unknown[0]}' is not known; choose from {', '.join(ways)}", 2)
    with console.status("starting ...") as line:
        try:
            rows = bench_ros(seconds, way or ways, line.update)
        except BenchError as error:
            fail(str(error))
    if json:
        print_json([row.document() for row in rows])
        return
    table = Table(
        title=f"A message from talker to listener, {seconds:g} s each: delays in ms, cpu in us",
        box=SIMPLE_HEAD,
        padding=0,
    )
    for i, heading in enumerate(("message", "way", "sent", "lost", "p50", "p99", "max", "nodes", "robot", "service")):
        table.add_column(heading, justify="right" if i > 1 else "left", no_wrap=True)
    for row in rows:
        delays = ("" if v is None else f"{v:.2f}" for v in (row.p50_ms, row.p99_ms, row.max_ms))
        costs = (f"{v:,.0f}" if v else "" for v in (row.nodes_us, row.robot_us, row.service_us))
        table.add_row(row.message, row.way, str(row.sent), str(row.sent - row.delivered), *delays, *costs)
    console.print(table)
    for name in dict.fromkeys(row.way for row in rows):
        row = next(row for row in rows if row.way == name)
        ends = f", both ends of the bridge {row.ends_rest:.1%}" if row.ends_rest else ""
        console.print(f"{name}, at rest: both nodes {row.nodes_rest:.1%} of a core{ends}", markup=False)
