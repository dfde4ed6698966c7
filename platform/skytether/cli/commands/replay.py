"""``skytether replay``: stream a recording to a service as a robot would."""

from __future__ import annotations

import shutil
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from skytether.api.client import ApiError, Client, Unreachable
from skytether.lab.embedded import EmbeddedError, EmbeddedOrchestrator
from skytether.robot.replay import replay as stream
from skytether.robot.replay.bag import Bag, BagError
from skytether.robot.replay.replay import ReplayConfig, ReplayError

from ..connection import TokenFile, connected
from ..output import SafeConsole, cell, console, fail, print_json, print_whole

if TYPE_CHECKING:
    from skytether.robot.replay.replay import ReplayResult


def replay(
    bag: Annotated[Path, typer.Argument(help="ROS 1 bag, ROS 2 bag or MCAP file.")],
    service: Annotated[str, typer.Option(help="What takes the topics in.")] = "recorder",
    speed: Annotated[float, typer.Option(min=0.01, max=1000, help="Times faster than it was recorded.")] = 1.0,
    topic: Annotated[list[str] | None, typer.Option(help="Send this topic only; may be given again.")] = None,
    remap: Annotated[
        list[str] | None, typer.Option(help="Send a topic under another name: /scan:=scan; may be given again.")
    ] = None,
    robot: Annotated[str, typer.Option(help="Name of the robot that is played.")] = "replay",
    url: Annotated[
        str | None,
        typer.Option(envvar="SKYTETHER_URL", help="Of the orchestrator; without it one is started for the replay."),
    ] = None,
    token_file: TokenFile = None,
    output: Annotated[
        Path, typer.Option(help="Folder for what the service writes, if the orchestrator was started for the replay.")
    ] = Path("replay-output"),
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object, and nothing else.")] = False,
) -> None:
    """Stream a recording to a service: through orchestrator and bridge, at its own times, byte for byte.

    Ends with exit status 0 only if every message arrived.
    """
    topics = tuple(topic) if topic else None
    config = ReplayConfig(bag, robot, service, topics=topics, remap=remappings(remap or []), speed=speed)
    try:
        if url is None:
            result, files = _with_own_orchestrator(config, output)
        else:
            with connected(url, token_file) as client:
                result, files = _stream(config, client), []
    except OSError as error:
        fail(f"cannot write to {error.filename or output}: {error.strerror}; give another folder with --output")
    except (ApiError, BagError, EmbeddedError, ReplayError, Unreachable) as error:
        fail(str(error))
    except KeyboardInterrupt:
        fail("interrupted; the instance was let go", 130)
    if json:
        print_json(_document(config, result, files))
    else:
        _print_table(config, result, files)
    if not result.complete:
        fail("not every message arrived")


def _with_own_orchestrator(config: ReplayConfig, output: Path) -> tuple[ReplayResult, list[Path]]:
    """Start an orchestrator, replay, and keep what the service wrote."""
    Bag(config.bag).close()  # what is wrong with the recording is told before anything is started
    output.mkdir(parents=True, exist_ok=True)
    with EmbeddedOrchestrator() as orchestrator:
        with Client(orchestrator.url, orchestrator.operator_token) as client:
            result = _stream(config, client)
        written = [path for path in orchestrator.state_dir.rglob(f"data/*/*/{result.instance}/*") if path.is_file()]
        return result, [Path(shutil.move(path, free_name(output / path.name))) for path in sorted(written)]


def remappings(texts: list[str]) -> dict[str, str]:
    """``OLD:=NEW``, as ROS writes it."""
    found: dict[str, str] = {}
    for text in texts:
        old, sign, new = text.partition(":=")
        if not (old and sign and new):
            fail(f"--remap must be OLD:=NEW, such as /scan:=scan, not '{text}'", 2)
        if old in found:
            fail(f"--remap: {old} is renamed twice", 2)
        found[old] = new
    return found


def free_name(path: Path) -> Path:
    """A name that nothing has yet: what was recorded before is never overwritten."""
    number = 1
    candidate = path
    while candidate.exists():
        number += 1
        candidate = path.with_stem(f"{path.stem}-{number}")
    return candidate


def _stream(config: ReplayConfig, client: Client) -> ReplayResult:
    """Replay with a bar on standard error."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(f"starting {config.service}", total=None)

        def show(progress: stream.Progress) -> None:
            if progress.total:
                bar.update(task, completed=progress.sent, total=progress.total, description=progress.stage)
            else:
                bar.update(task, description=f"{progress.stage} {config.service}")

        return stream.replay(config, client, show)


def _document(config: ReplayConfig, result: ReplayResult, files: list[Path]) -> dict[str, Any]:
    return {
        "bag": str(config.bag),
        "service": config.service,
        "robot": config.robot,
        "instance": result.instance,
        "speed": config.speed,
        "time_s": round(result.seconds, 3),
        "complete": result.complete,
        "topics": {
            topic.topic: {
                "type": topic.type,
                "messages": topic.messages,
                "refused": topic.refused,
                "dropped": topic.dropped,
                "sent": topic.sent,
                "delivered": topic.delivered,
                "lost": topic.lost,
                "delay_p50_ms": _ms(topic.delay_p50_s),
                "delay_p99_ms": _ms(topic.delay_p99_s),
            }
            for topic in result.topics
        },
        "files": [str(path) for path in files],
    }


def _ms(seconds: float) -> float | None:
    return round(seconds * 1000, 3) if isfinite(seconds) else None


def _print_table(config: ReplayConfig, result: ReplayResult, files: list[Path]) -> None:

    table = Table(title=cell(f"{config.bag.name} to {config.service}, {result.seconds:.1f} s"))
    table.add_column("topic")
    table.add_column("type")
    for name in ("messages", "refused", "dropped", "sent", "delivered", "lost", "p50 ms", "p99 ms"):
        table.add_column(name, justify="right")
    for topic in result.topics:
        counts = (topic.messages, topic.refused, topic.dropped, topic.sent, topic.delivered, topic.lost)
        delays = (_ms(topic.delay_p50_s), _ms(topic.delay_p99_s))
        table.add_row(
            cell(topic.topic),
            cell(topic.type),
            *map(str, counts),
            *("-" if ms is None else f"{ms:.2f}" for ms in delays),
        )
    print_whole(table)
    out = SafeConsole(highlight=False)
    for path in files:
        out.print(f"written: {path}", markup=False, soft_wrap=True)
    if not files:
        where = f"data/{config.robot}/{config.service}/{result.instance}"
        out.print(f"What the service wrote is on its site, in {where}.", markup=False, soft_wrap=True)
