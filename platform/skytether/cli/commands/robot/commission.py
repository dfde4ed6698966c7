"""``skytether robot commission``: measure on the real robot what its safety counts on."""

from __future__ import annotations

import json
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import typer

from skytether.api.config_file import ConfigError
from skytether.guard.velocity import Velocity
from skytether.robot.config.gate_config import load_safety
from skytether.robot.control.supervisor import VelocityLimits
from skytether.robot.safety.commission.commission import Commission, CommissionError, Plan, Step
from skytether.robot.safety.commission.rig import HardwareRig

from ...output import fail


def commission(
    config: Annotated[Path, typer.Argument(metavar="ROBOT.YAML", help="With sections safety and safety.odometry.")],
    only: Annotated[list[str] | None, typer.Option(help="This step only; may be given again.")] = None,
    record: Annotated[Path | None, typer.Option(help="Write the JSON record to this file, too.")] = None,
) -> None:
    """Measure on the real robot what its safety counts on, step by step; each is asked for first.

    The emergency stop button, the directions of the axes, the drives' own watchdog, braking and reaction with the
    numbers to configure, and the enable signal. End the gate before: no sensor looks where the robot goes meanwhile.
    Questions are on standard error, answers are lines of standard input, the JSON record goes to standard output.
    """
    try:
        settings = load_safety(config)
    except ConfigError as error:
        fail(str(error), 2)
    try:
        rig = HardwareRig(settings)
    except CommissionError as error:
        fail(str(error))
    odometry = settings.odometry
    if odometry is None:  # the rig has said so
        return

    plan = Plan(
        limits=settings.limits or VelocityLimits(),
        reaction_s=settings.zones.reaction_s,
        tolerance=Velocity(odometry.linear_tolerance, odometry.angular_tolerance),
        button=settings.estop is not None,
        enable=settings.enable is not None,
    )
    work = Commission(plan, rig, _ask, _print)
    known = work.steps()
    done: list[Step] = []
    stopped = ""
    try:
        wanted = only or list(known)
        unknown = [name for name in wanted if name not in known]
        if unknown:
            fail(f"there is no step '{unknown[0]}'; there are {', '.join(known)}", 2)
        _print("No sensor looks where the robot goes. Keep a hand on the emergency stop and the way free.")
        for name in wanted:
            done.append(known[name]())
            _print(f"{name}: {_word(done[-1].ok)}: {done[-1].says}")
    except (CommissionError, KeyboardInterrupt) as error:
        stopped = str(error) or "ended by the person"
        _print(f"ended: {stopped}")
    finally:
        rig.close()
    document = {
        "at": datetime.now(UTC).isoformat(timespec="seconds"),
        "robot": str(config),
        "passed": not stopped and any(step.ok for step in done) and all(step.ok is not False for step in done),
        "ended": stopped,
        "steps": [{"step": s.name, "ok": s.ok, "says": s.says, **s.measured} for s in done],
        "proposal": work.proposal,
    }
    _keep(document, record)
    if not document["passed"]:
        raise typer.Exit(1)


def _keep(document: dict[str, Any], record: Path | None) -> None:
    text = json.dumps(document, indent=2, allow_nan=False)
    print(text)
    if record is not None:
        try:
            record.write_text(text + "\n")
        except OSError as error:
            fail(f"cannot write {record}: {error.strerror}")


def _word(ok: bool | None) -> str:
    return "left out" if ok is None else "good" if ok else "FAILED"


def _print(sentence: str) -> None:
    print(sentence, file=sys.stderr, flush=True)


def _ask(question: str) -> bool:
    _print(f"{question} [y/N]")
    return sys.stdin.readline().strip().lower() in ("y", "yes")
