"""``skytether lab``: experiments and benchmarks."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ...output import console, fail, print_json, silenced
from .authentication import authentication
from .face import face
from .failover import alarms, failover
from .hostile import hostile
from .legs import legs
from .navigation import localisation, mapping, navigation
from .resize import resize
from .ros import ros
from .run import app as run_app
from .safety import safety
from .scale import scale
from .world import world

app = typer.Typer(help="Experiments and benchmarks on this machine.", no_args_is_help=True)
bench = typer.Typer(help="Measure the real program, and print what was measured.", no_args_is_help=True)
app.add_typer(bench, name="bench")
app.add_typer(run_app, name="run")
app.command("world")(world)
bench.command("safety")(safety)
bench.command("resize")(resize)
bench.command("ros")(ros)
bench.command("hostile")(hostile)
bench.command("scale")(scale)
bench.command("authentication")(authentication)
bench.command("mapping")(mapping)
bench.command("localisation")(localisation)
bench.command("navigation")(navigation)
bench.command("face")(face)
bench.command("legs")(legs)
scenario = typer.Typer(help="Experiments of the thesis, done with the real program.", no_args_is_help=True)
app.add_typer(scenario, name="scenario")


@scenario.command("handover")
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
    from rich.table import Table

    from skytether.bridge import BridgeError
    from skytether.lab.handover import VARIANTS, HandoverError
    from skytether.lab.handover import handover as run

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


@bench.command("start")
def start(
    n: Annotated[int, typer.Option("-n", min=1, max=1000, help="Starts to measure.")] = 20,
    runtime: Annotated[
        list[str] | None, typer.Option(help="process, docker or kubernetes; may be repeated. Default: process.")
    ] = None,
    service: Annotated[str, typer.Option(help="virtual-trail, or navigation (extra `lab`).")] = "virtual-trail",
    prefix: Annotated[str, typer.Option(help="Of the images' names.")] = "skytether/",
    json: Annotated[
        bool,
        typer.Option("--json", help="Print rows `runtime, standby, p50_s, p99_s, n, moving_p50_s, moving_p99_s`."),
    ] = False,
) -> None:
    """Time from a robot's request over REST to the first velocity command that it accepts.

    With navigation also to the first that moves the robot: on its way to a goal, on a map that it gives the service.

    With docker, the images must be there (`make images`), and `docker run` of the same image is timed in turn, until
    its service listens; each after three seconds of rest.

    With kubernetes, the nodes of the cluster of KUBECONFIG have the images; pods are in a namespace that is removed.
    """
    from rich.table import Table

    from skytether.lab.bench.pair import BenchError
    from skytether.lab.bench.start import bench_start
    from skytether.lab.embedded import EmbeddedError

    try:
        with console.status("starting ...") as line:
            rows = bench_start(
                n, runtime or ["process"], prefix, lambda row, s: line.update(f"{row}: {s:.3f} s"), service
            )
    except (BenchError, EmbeddedError) as error:
        fail(str(error))
    if json:
        print_json([row.document() for row in rows])
        return
    moves = any(row.moving_p50_s is not None for row in rows)
    more = ("moving p50 [s]", "moving p99 [s]") if moves else ()
    title = "Request to first velocity command"
    table = Table("runtime", "standby", "p50 [s]", "p99 [s]", *more, "starts", title=title)
    for row in rows:
        times = (row.p50_s, row.p99_s, *((row.moving_p50_s, row.moving_p99_s) if moves else ()))
        shown = ("" if time is None else f"{time:.3f}" for time in times)
        table.add_row(row.runtime, str(row.standby), *shown, str(row.n))
    console.print(table)


@bench.command("join")
def join(
    prefix: Annotated[str, typer.Option(help="Of the images' names, which the engine has.")] = "skytether/",
    json: Annotated[bool, typer.Option("--json", help="Print rows `step, took_s`.")] = False,
) -> None:
    """Time from a machine that has nothing but a Docker engine to a robot that is driven from there, by step.

    This machine's engine joins an orchestrator that is started for it; a robot asks for virtual-trail.
    """
    from rich.table import Table

    from skytether.lab.bench.join import bench_join
    from skytether.lab.bench.pair import BenchError
    from skytether.lab.embedded import EmbeddedError

    try:
        with console.status("starting ...") as line:
            rows = bench_join(prefix, line.update)
    except (BenchError, EmbeddedError) as error:
        fail(str(error))
    if json:
        print_json([row.document() for row in rows])
        return
    table = Table("step", "took [s]", title="From an engine to the first velocity command")
    for row in rows:
        table.add_row(row.step, f"{row.took_s:.3f}")
    console.print(table)


@bench.command("migrate")
def migrate(
    n: Annotated[int, typer.Option("-n", min=1, max=1000, help="Moves.")] = 10,
    json: Annotated[bool, typer.Option("--json", help="Print one row.")] = False,
) -> None:
    """Move a service from one site to another under a driven robot: the longest time without a command.

    Beside it, the same while nothing happens, and around the start of another program of the service's size.
    """
    from rich.table import Table

    from skytether.lab.bench.migrate import bench_migrate
    from skytether.lab.bench.pair import BenchError
    from skytether.lab.embedded import EmbeddedError

    try:
        with console.status("starting ...") as line:
            row = bench_migrate(n, lambda i, gap: line.update(f"move {i + 1} of {n}: {gap:.1f} ms"))
    except (BenchError, EmbeddedError) as error:
        fail(str(error))
    if json:
        print_json(row.document())
        return
    table = Table(title="Longest gap between commands when a service moves")
    for heading in ("", "p50 [ms]", "max [ms]"):
        table.add_column(heading, justify="right")
    table.add_row("around a move", f"{row.gap_p50_ms:.1f}", f"{row.gap_max_ms:.1f}")
    table.add_row("around the start of another program", f"{row.gap_start_p50_ms:.1f}", f"{row.gap_start_max_ms:.1f}")
    table.add_row("without a move", f"{row.gap_still_p50_ms:.1f}", f"{row.gap_still_max_ms:.1f}")
    console.print(table)
    console.print(
        f"{row.n} moves, {row.move_p50_s:.2f} s each, {row.fallbacks} with the robot's own controller in between; "
        f"two periods are {row.bound_ms:g} ms"
    )


@bench.command("api")
def api(
    instances: Annotated[int, typer.Option(min=1, max=2000, help="Sleeping instances that run meanwhile.")] = 200,
    rate: Annotated[float, typer.Option(min=1, max=10_000, help="Requests a second.")] = 100,
    seconds: Annotated[float, typer.Option(min=1, max=600, help="For how long.")] = 20,
    json: Annotated[bool, typer.Option("--json", help="Print one row.")] = False,
) -> None:
    """Ask an orchestrator that runs many instances: its answers, its reconcile passes, its memory."""
    from rich.table import Table

    from skytether.lab.bench.api import bench_api
    from skytether.lab.bench.pair import BenchError
    from skytether.lab.embedded import EmbeddedError

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


@bench.command("fleet")
def fleet(
    robots: Annotated[int, typer.Option(min=6, max=1000, help="Of the fleet, each with its instance.")] = 100,
    seconds: Annotated[float, typer.Option(min=4, max=3600, help="Of traffic, in made-up time.")] = 20,
    json: Annotated[bool, typer.Option("--json", help="Print one row.")] = False,
) -> None:
    """Disturb a fleet in every way, and compare what it counted with what its orchestrator exports.

    100 robots take some minutes: both ends of each bridge are real, the link between them is made up.
    """
    from rich.table import Table

    from skytether.lab.bench.fleet import bench_fleet
    from skytether.lab.bench.pair import BenchError
    from skytether.lab.embedded import EmbeddedError

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


bench.command("failover")(failover)
bench.command("alarms")(alarms)


@bench.command("bridge")
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
    from skytether.lab.bench.bridge import BenchError, make_plan, run
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
