"""``skytether demo``: the main job, on this machine, in about a minute."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from skytether.api.client import ApiError, Unreachable
from skytether.lab.embedded import EmbeddedError
from skytether.robot.agent.snapshot import AgentStatus
from skytether.robot.control import control_loop as robot_driver

from ..output import console, fail, print_json, silenced

if TYPE_CHECKING:
    from skytether.lab.demo import Demo, DemoResult
    from skytether.robot.control.control_status import Transition


def demo(
    rtt_ms: Annotated[float, typer.Option(min=0, max=5000, help="Round trip of the emulated network.")] = 100,
    loss: Annotated[float, typer.Option(min=0, max=0.9, help="Share of packets lost, each way.")] = 0.01,
    jitter_ms: Annotated[float, typer.Option(min=0, max=1000, help="Deviation of the one-way delay.")] = 0,
    burst: Annotated[float | None, typer.Option(min=1, help="Mean length of a run of lost packets.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of person, sensor noise and network.")] = 1,
    output: Annotated[Path, typer.Option(help="Folder for the plot.")] = Path("demo-output"),
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object, and nothing else.")] = False,
) -> None:
    """Guide a simulated smart walker along the trail, across an emulated network.

    Starts an orchestrator, then a walker that asks it for virtual-trail. Ends with exit status 0 only if the walker
    completed the trail.
    """
    from skytether.lab.demo import Demo, DemoError, DemoSettings

    try:
        output.mkdir(parents=True, exist_ok=True)
        settings = DemoSettings(rtt_ms / 1000, jitter_ms / 1000, loss, burst, seed, output)
        settings.link(0)
    except OSError as error:
        fail(f"cannot make the folder {output}: {error.strerror}; give another with --output", 2)
    except ValueError as error:
        fail(str(error), 2)
    try:
        console.print("Starting orchestrator, network and walker ...")
        with Demo(settings) as running:
            result = _walk(running)
            console.print("Shutting down ...")
    except (DemoError, EmbeddedError, ApiError, Unreachable) as error:
        fail(str(error))
    if json:
        print_json(result.document())
    else:
        _print_tables(result)
    if not result.measures.completed:
        fail(f"the trail was not completed within {settings.walk_limit_s:.0f} s; the path is in {result.plot}")


def _walk(running: Demo) -> DemoResult:
    """Show how it goes while it goes."""
    handed_over = 0.0
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.completed:.1f} of {task.total:.1f} m"),
        TimeElapsedColumn(),
        TextColumn("{task.fields[now]}"),
    )
    # Its warnings of hand-overs are told here in people's words.
    with silenced(robot_driver.__name__), Progress(*columns, console=console) as progress:
        task = progress.add_task("walking", total=running.trail.length, now="")

        def show(s: float, status: AgentStatus) -> None:
            nonlocal handed_over
            driver = status.driver
            for change in driver.transitions[1:]:  # the first is the start
                if change.at > handed_over:
                    handed_over = change.at
                    console.print(_told(change, s))
            now = f"{driver.velocity.linear:.2f} m/s, driven by {driver.source}, round trip {status.rtt * 1000:.0f} ms"
            progress.update(task, completed=s, now=now)

        return running.walk(show)


def _told(change: Transition, s: float) -> str:
    """One hand-over, in people's words."""
    drives = {"cloud": "the service drives", "fallback": "the walker's own controller drives", "stop": "nobody drives"}
    why = {
        "no_command": "no valid command came in time",
        "disconnected": "the service is not connected",
        "rtt": "the round trip is longer than the service bears",
        "loss": "more is lost than the service bears",
        "late": "more comes too late than the service bears",
        "clock": "the age of commands is not known well enough",
        "neutral": "it has not wanted a standstill since the robot was reset",
        "recovered": "its commands come in time",
    }
    return f"At {s:.1f} m {drives[change.source]}: {why.get(change.reason, change.reason)}."


def _print_tables(result: DemoResult) -> None:
    console.print(_facts(result))
    console.print(_topics(result))
    console.print(f"The path walked: {result.plot}", soft_wrap=True)


def _facts(result: DemoResult) -> Table:

    walk = result.measures
    table = Table(title="The walk", show_header=False)
    for name, value in (
        ("completed", "yes" if walk.completed else "no"),
        ("time to completion", f"{walk.time_s:.1f} s"),
        ("mean speed", f"{walk.mean_speed_m_s:.3f} m/s"),
        ("kinematic tracking error", f"{walk.kte_m * 1000:.1f} mm"),
        ("under local control", f"{result.fallback_s:.2f} s"),
        ("start: request to first command", f"{result.start_s:.3f} s"),
        ("path round trip, median", f"{result.rtt_s * 1000:.1f} ms"),
    ):
        table.add_row(name, value)
    return table


def _topics(result: DemoResult) -> Table:

    table = Table(title="Topics: one-way delay and jitter in ms")
    counted = ("refused", "dropped", "sent", "delivered", "superseded", "lost", "unsettled")
    for heading in ("topic", *counted, "delay p50", "delay p99", "jitter"):
        table.add_column(heading, justify="left" if heading == "topic" else "right")
    for topic in result.topics:
        times = (topic.delay_p50, topic.delay_p99, topic.jitter)
        table.add_row(
            topic.topic,
            *(str(getattr(topic, name)) for name in counted),
            *(f"{seconds * 1000:.1f}" for seconds in times),
        )
    return table
