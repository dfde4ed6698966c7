"""``skytether bridge``: ends of a bridge without an orchestrator, and what they measure."""

from __future__ import annotations

import dataclasses
import math
import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Group
from rich.live import Live
from rich.table import Table

from skytether.api.config_file import ConfigError
from skytether.bridge.endpoint import BridgeError
from skytether.ros.notes import NOTES

from ...end_signal import EndSignal
from ...output import console, fail, print_json
from .config import load_config, load_key, write_new_key
from .ends import start_ends

if TYPE_CHECKING:
    from skytether.wire.stats import SessionStats

    from .config import BridgeConfig


def bridge(
    config: Annotated[
        Path | None, typer.Option(help="YAML of this end: role, id, key_file, bind, peer, topics, ...")
    ] = None,
    seconds: Annotated[float | None, typer.Option(min=0.1, help="End after this long; without it at Ctrl-C.")] = None,
    json: Annotated[
        bool, typer.Option("--json", help="Each second one JSON document for each end on standard output.")
    ] = False,
    new_key: Annotated[Path | None, typer.Option(help="Make a key file for both ends, and do nothing else.")] = None,
) -> None:
    """Join two graphs over UDP without an orchestrator: run it at each end with the same id, key and topics.

    With ros1: or ros2: in the configuration this end is a graph of ROS. Sources publish made-up messages instead, so
    that a network can be measured before a robot depends on it.
    """
    try:
        if new_key is not None:
            write_new_key(new_key)
            console.print(f"{new_key} holds the key; copy it to the other end in a safe way", soft_wrap=True)
            return
        if config is None:
            fail("name a configuration with --config FILE, or make a key with --new-key FILE", 2)
        settings = load_config(config)
        key = load_key(config.parent / settings.key_file)
    except ConfigError as error:
        fail(str(error), 2)
    _run(settings, key, config.parent, seconds, as_json=json)


def _run(settings: BridgeConfig, key: bytes, folder: Path, seconds: float | None, *, as_json: bool) -> None:
    signalled = EndSignal()
    with ExitStack() as stack:
        try:
            ends = start_ends(settings, key, stack, folder)
        except ConfigError as error:
            fail(str(error), 2)
        except BridgeError as error:
            fail(f"{error}; change bind or peer in the configuration")
        except ValueError as error:
            fail(str(error), 2)
        for end in ends:
            console.print(f"{end.role}: listens on UDP {_where(end.bridge.address)}", markup=False, soft_wrap=True)
        live = None if as_json else stack.enter_context(Live(console=console, auto_refresh=False))
        start = time.monotonic()
        elapsed = 0.0
        while not signalled.came and (seconds is None or elapsed < seconds):
            until = math.floor(elapsed) + 1 if seconds is None else min(math.floor(elapsed) + 1, seconds)
            signalled.wait(max(0.0, start + until - time.monotonic()))
            elapsed = time.monotonic() - start
            shown = [(end.role, end.bridge.stats()) for end in ends]
            if live is not None:
                live.update(Group(*(_table(role, stats) for role, stats in shown)), refresh=True)
            else:
                for role, stats in shown:
                    print_json({"seconds": round(elapsed, 3), "end": role, **_plain(dataclasses.asdict(stats))})
    for end in ends:
        if end.refusal:
            fail(f"{end.role}: the topics of the two ends do not fit: {end.refusal}")
        if not end.was_connected:
            fail(
                f"{end.role}: no session came up; check that the peer runs, that it can be reached,"
                " and that id and key are the same at both ends"
            )


def _where(address: tuple[str, int]) -> str:
    host, port = address
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def _plain(value: Any) -> Any:
    """What was not measured (NaN, infinity) is null in JSON."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return value


def _table(role: str, stats: SessionStats) -> Table:
    """Statistics of one end for people."""
    state = "connected" if stats.connected else "waiting for the peer"
    for path in stats.paths:
        rtt, loss = _number(path.rtt, 1000, " ms"), _number(path.loss_out, 100, " %")
        state += f"; path {path.path}: round trip {rtt}, loss {loss}"
    # Eleven columns in 80 characters, so that a narrow terminal shows whole names.
    table = Table(
        title=f"{role}: {state}; delays in ms",
        caption="published = refused + dropped + sent; sent = delivered + old + lost + open",
        caption_justify="left",
        title_justify="left",
        box=SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
        pad_edge=False,
    )
    table.add_column("topic", overflow="fold", min_width=14)
    table.add_column("dir", min_width=3)
    for column in ("refused", "dropped", "sent", "delivered", "old", "lost", "open", "p50", "p99", "jitter"):
        table.add_column(column, justify="right", min_width=len(column))
    for t in (t for t in stats.topics if t.topic not in NOTES.values()):
        counts = (t.refused, t.dropped, t.sent, t.delivered, t.superseded, t.lost, t.unsettled)
        times = (t.delay_p50, t.delay_p99, t.jitter)
        table.add_row(
            t.topic,
            t.direction,
            *map(str, counts),
            *(_number(x, 1000) for x in times),
        )
    return table


def _number(value: float, scale: float, unit: str = "") -> str:
    return f"{value * scale:.1f}{unit}" if math.isfinite(value) else "-"
