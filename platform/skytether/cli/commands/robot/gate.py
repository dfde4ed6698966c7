"""``skytether robot gate, safety-log``: the last gate before the wheels, and its record."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from skytether.api.config_file import ConfigError
from skytether.guard.record import decode
from skytether.robot.config.gate_config import load_safety
from skytether.robot.safety.gate.start import become_guard
from skytether.robot.safety.protocol import default_record

from ...output import fail, print_foreign, print_json
from ...ros_words import RosWords, given

Json = Annotated[bool, typer.Option("--json", help="One JSON document on standard output.")]


def gate(
    config: Annotated[Path, typer.Argument(metavar="ROBOT.YAML", help="With a section safety.")],
    ros: RosWords = None,
) -> None:
    """Own the wheels: let velocities through that are safe, and stop the robot when there are none.

    Runs beside the agent, as processes of its own, and needs neither network nor agent. This command checks the
    configuration and then becomes the guard, a small process that reads no file. docs/safety.md tells more.
    """
    try:
        become_guard(load_safety(config, given(ros)))
    except ConfigError as error:
        fail(str(error), 2)
    except OSError as error:
        fail(f"the gate cannot be started: {error}")


def safety_log(
    config: Annotated[
        Path | None, typer.Argument(metavar="[ROBOT.YAML]", help="Whose record; without it the usual one.")
    ] = None,
    record: Annotated[Path | None, typer.Option(help="The file (safety.record in robot.yaml).")] = None,
    last: Annotated[int, typer.Option(min=1, help="So many events, the newest.")] = 50,
    json: Json = False,
) -> None:
    """Show the safety event record: what stopped the robot, who reset it, what died.

    It survives reboots, and has its full size from the start; the oldest events go first.
    """
    try:
        path = record or (default_record() if config is None else load_safety(config).record_file())
        events = decode(path.read_bytes())[-last:]
    except ConfigError as error:
        fail(str(error), 2)
    except OSError as error:
        fail(f"cannot read the event record {path}: {error.strerror}; name another with --record, or give robot.yaml")
    if json:
        print_json(events)
        return
    for event in events:
        when = datetime.fromtimestamp(float(str(event.get("wall", 0))), UTC).astimezone()
        _print(
            f"{when:%Y-%m-%d %H:%M:%S}  {event.get('who', ''):<7} {event.get('what', ''):<8} {event.get('detail', '')}"
        )
        if lost := event.get("lost_before"):
            _print(f"{'':21}before this, {lost} events were lost")


def _print(line: str) -> None:
    """A line, some of which others may have written: the reason of a stop, say."""
    print_foreign(f"{line}\n")
