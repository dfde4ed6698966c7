"""``skytether lab bench failover`` and ``alarms``: how soon a robot helps itself, and how often for no reason."""

from __future__ import annotations

import os
from typing import Annotated

import typer
from rich.table import Table

from skytether.lab.bench.alarms import bench_alarms
from skytether.lab.bench.failover import RATES_HZ, bench_failover
from skytether.lab.bench.pair import BenchError
from skytether.robot.control import control_loop

from ...output import console, fail, print_json, silenced

_Rates = Annotated[
    list[float] | None,
    typer.Option("--rate", help="Commands per second; may be repeated. Default: 100, 50, 20, 10, 5."),
]


def failover(
    n: Annotated[int, typer.Option("-n", min=1, max=10_000, help="Cuts at each rate.")] = 20,
    rate: _Rates = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the moments at which the link is cut.")] = 1,
    json: Annotated[bool, typer.Option("--json", help="Print a list of rows, one for each rate.")] = False,
) -> None:
    """Cut the link under a driven robot, and time it until its own controller drives.

    The bound is three periods of the commands and 1.25 times their jitter,
    two periods and 30 ms at least, 0.4 s or four periods at most,
    and 20 ms for two turns of the control loop.
    Ends with exit status 1 if it was missed.
    """
    try:
        with silenced(control_loop.__name__), console.status("starting ...") as line:
            rows = bench_failover(rate or RATES_HZ, n, seed, lambda r, i: line.update(f"{r:g} Hz: cut {i} of {n}"))
    except ValueError as error:
        fail(str(error), 2)
    except (BenchError, OSError) as error:
        fail(str(error))
    if json:
        print_json([row.document() for row in rows])
    else:
        table = Table(title="From cut to local control")
        for heading in ("rate [Hz]", "p50 [ms]", "p99 [ms]", "max [ms]", "jitter [ms]", "bound [ms]"):
            table.add_column(heading, justify="right")
        table.add_column("largest jump [m/s]", justify="right")
        table.add_column("cuts", justify="right")
        for row in rows:
            times = (row.cut_to_local_p50_ms, row.cut_to_local_p99_ms, row.cut_to_local_max_ms, row.jitter_ms)
            table.add_row(
                f"{row.rate_hz:g}",
                *(f"{t:.0f}" for t in (*times, row.bound_ms)),
                f"{row.velocity_jump_max_m_s:.3f}",
                str(row.n),
            )
        console.print(table)
    missed = [row for row in rows if row.cut_to_local_max_ms > row.bound_ms]
    if missed:
        fail(f"a bound was missed at {', '.join(f'{row.rate_hz:g} Hz' for row in missed)}; is the machine busy?")


def alarms(
    rate: _Rates = None,
    seconds: Annotated[float, typer.Option(min=1, max=86_400, help="For each rate; 3600: an hour.")] = 60.0,
    busy: Annotated[
        int | None, typer.Option(min=0, max=1024, help="Busy programs beside it. Default: one for each processor.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print a list of rows, one for each rate.")] = False,
) -> None:
    """Drive a robot over a link that is never cut, beside busy programs, and count its needless stops.

    Ends with exit status 1 if there was a hand-over.
    """
    programs = os.cpu_count() or 1 if busy is None else busy
    try:
        with silenced(control_loop.__name__), console.status("starting ...") as line:
            rows = bench_alarms(
                rate or RATES_HZ,
                seconds,
                programs,
                lambda r, s, n: line.update(f"{r:g} Hz: {s:.0f} of {seconds:.0f} s, {n} hand-overs"),
            )
    except ValueError as error:
        fail(str(error), 2)
    except (BenchError, OSError) as error:
        fail(str(error))
    if json:
        print_json([row.document() for row in rows])
    else:
        table = Table(title=f"Needless stops beside {programs} busy programs")
        for heading in ("rate [Hz]", "time [s]", "hand-overs", "stalls", "gap p99 [ms]", "longest [ms]", "limit [ms]"):
            table.add_column(heading, justify="right")
        for row in rows:
            times = (row.gap_p99_ms, row.gap_max_ms, row.limit_ms)
            table.add_row(
                f"{row.rate_hz:g}",
                f"{row.seconds:.0f}",
                str(row.hand_overs),
                str(row.stalls),
                *(f"{t:.0f}" for t in times),
            )
        console.print(table)
    if any(row.hand_overs for row in rows):
        fail("the robot was left to itself though nothing was cut")
