"""``skytether lab bench bridge``: the bridge beside other transports."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from skytether.lab.bench.bridge import BenchError, make_plan, run

from ...output import console, fail, print_json


def bridge(
    suite: Annotated[
        str, typer.Option(help="What to measure: table2, fig26, throughput, saturated or latency.")
    ] = "table2",
    condition: Annotated[
        list[str] | None, typer.Option(help="Link of the suite table2; may be repeated. Default: all but the sweep.")
    ] = None,
    transport: Annotated[
        list[str] | None, typer.Option(help="What to compare; may be repeated. Default: the suite's.")
    ] = None,
    seconds: Annotated[
        float | None, typer.Option(min=0.5, max=3600, help="Length of each measurement. Default: the suite's.")
    ] = None,
    emulator: Annotated[
        str, typer.Option(help="tun: IP packets between network namespaces (root); user: UDP on loopback; auto.")
    ] = "auto",
    congestion: Annotated[
        str | None, typer.Option(help="TCP's congestion control. Default: bbr where the kernel has it, else cubic.")
    ] = None,
    camera_last: Annotated[
        bool, typer.Option("--camera-last", help="Rank the camera below all else, not second as in the thesis.")
    ] = False,
    json: Annotated[bool, typer.Option("--json", help="Print a list of rows, one for each topic.")] = False,
    output: Annotated[Path | None, typer.Option(help="Folder for the report, its plots and rows.json.")] = None,
) -> None:
    """The bridge and other transports: the same traffic on the same bad links.

    Delays are one way, from the call that sends to the call that delivers,
    between processes on one clock. Processor time is that of each end's
    whole process, which makes and checks the messages too: the same work
    for every transport.

    Suites: table2 (thesis Table 2 traffic over emulated links), fig26 (loss
    over size and rate on loopback, thesis figure 26), throughput (of 64 kB
    messages, and of messages of 100 B), saturated (velocity commands beside
    a camera that fills 5 Mbit/s), latency (on loopback).

    Links of table2: ideal, 50ms-1%, 50ms-5%, commercial, private, burst;
    commercial-ordered and private-ordered, whose jitter never reorders;
    sweep (50 ms with 0 to 30 % loss, or one of them: loss-0%, loss-1%,
    loss-2%, loss-5%, loss-10%, loss-15%, loss-20%, loss-25%, loss-30%).

    Transports: skytether, udp, tcp, websocket-cbor, zenoh-tcp, zenoh-2tcp,
    zenoh-quic, zenoh-udp, zenoh-mixed; ROS 2 over Fast DDS across the link,
    without any bridge: ros2-best-effort, ros2-reliable,
    ros2-tuned-best-effort, ros2-tuned-reliable (asynchronous, flow
    controller, fragments under the MTU); cyclone-best-effort and
    cyclone-reliable. These six run under ROS 2's own Python: that of
    `make ros2`, or the one that SKYTETHER_ROS2_PYTHON names.

    Each row of --json has: transport, condition, topic, sent, delivered,
    delay_p50_ms, delay_p95_ms, delay_p99_ms, delay_max_ms, overhead (bytes
    on the link beyond payload, over payload), cpu_s, cpu_robot_s,
    cpu_service_s, congestion, emulator, emulator_late_ms, size, seconds.
    """
    from skytether.lab.bench.report import console_table, write_report

    try:
        plan = make_plan(
            suite,
            condition=condition or (),
            transport=transport or (),
            seconds=seconds,
            emulator=emulator,
            congestion=congestion,
            camera_last=camera_last,
        )
    except ValueError as error:
        fail(str(error), 2)
    except BenchError as error:
        fail(str(error))
    for note in plan.notes:
        console.print(note, style="dim", markup=False)
    failures: list[str] = []
    with console.status("starting ...") as line:
        rows = list(run(plan, line.update, failures.append))
    for sentence in failures:
        console.print(f"not measured: {sentence}", style="yellow", markup=False)
    if not rows:
        fail("nothing could be measured")
    if output is not None:
        write_report(plan, rows, failures, output)
        console.print(f"report: {output / 'report.md'}", markup=False)
    if json:
        print_json([row.document() for row in rows])
        return
    console.print(console_table(rows, plan.title))
