"""``skytether robot run --check``: is everything there that a run will need?"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from rich.table import Table

from skytether.api.client import ApiError, Client, Unreachable
from skytether.api.manifest import Manifest
from skytether.guard.record import lost_at_reboot
from skytether.robot.config.robot_config import RobotConfig
from skytether.robot.graphs.finding import Finding
from skytether.robot.safety.client import GateError, ask, listens

from ...output import cell, console, print_whole
from .gate_process import ASSUMED, NO_GATE


def check_run(settings: RobotConfig, folder: Path, token: str, role: str = "check") -> list[Finding]:
    """Everything that a run will need, one by one.

    Args:
        settings: The file.
        folder: That its paths are relative to.
        token: The robot's.
        role: Who checks.

    Raises:
        ConfigError: The graph cannot be joined.
    """
    manifest, findings = check_orchestrator(settings, token)
    findings += settings.kind.check(
        settings.graph,
        settings.graph_config,
        folder,
        manifest=manifest,
        command_topic=settings.command_topic,
        role=role,
    )
    return [*findings, *plausible(settings), check_gate(settings), *check_record(settings)]


def plausible(settings: RobotConfig) -> list[Finding]:
    """The numbers that the file says are meant to be beyond what is plausible; they will do."""
    notes = list(settings.notes())
    notes += [f"safety.{note}" for note in (settings.safety.notes() if settings.safety else ())]
    return [Finding("beyond", "robot.yaml", "", note) for note in notes]


def show(findings: Sequence[Finding]) -> bool:
    """Print a table. True if nothing is wrong."""
    table = Table(box=None, pad_edge=False)
    for head in ("", "what", "in the graph", "type", "found"):
        table.add_column(head, overflow="fold")
    for f in findings:
        table.add_row(
            "!!" if not f.good else ".." if f.missing else "ok", *map(cell, (f.what, f.where, f.kind, f.says))
        )
    print_whole(table)
    wrong = sum(not f.good for f in findings)
    missing = [f.where or f.what for f in findings if f.missing]
    said = f"{wrong} to mend, marked !!" if wrong else "all is there" if not missing else "nothing is to mend"
    said += f"; not there yet, and waited for: {', '.join(missing)}" if missing else ""
    console.print(said, markup=False, soft_wrap=True)
    return not wrong


def check_orchestrator(settings: RobotConfig, token: str) -> tuple[Manifest | None, list[Finding]]:
    """Whether it has the service, and what that takes and gives."""
    try:
        with Client(
            settings.orchestrator,
            token,
            ca_file=settings.ca_file or os.environ.get("SKYTETHER_CA_FILE"),
            insecure_http=settings.insecure_http,
        ) as client:
            manifest = client.get_service(settings.service)
    except (ApiError, Unreachable) as error:
        return None, [Finding("orchestrator", settings.orchestrator, "", str(error), good=False)]
    says = f"service {settings.service}, {len(manifest.spec.topics)} topics, calls and actions"
    return manifest, [Finding("orchestrator", settings.orchestrator, "", says)]


def check_gate(settings: RobotConfig) -> Finding:
    """Whether there is a gate before the wheels, or will be, and whether it is stopped."""
    safety = settings.safety
    if safety is None:
        return Finding("gate", "", "", f"warning: {NO_GATE}")
    assumed = f"; {ASSUMED}" if settings.gate_is_assumed else ""
    where = str(safety.place())
    if not listens(safety.place()):
        return Finding("gate", where, "", f"does not run yet; `skytether robot run` starts it{assumed}")
    try:
        stopped = ask(safety.place(), {"do": "status"})["stopped"]
    except GateError as error:
        return Finding("gate", where, "", str(error), good=False)
    says = f"has the wheels, and is stopped: {stopped}" if stopped else "has the wheels"
    return Finding("gate", where, "", f"{says}{assumed}", good=not stopped)


def check_record(settings: RobotConfig) -> list[Finding]:
    """Whether what stopped the robot will be known after a reboot; a warning, for the gate does its work without."""
    safety = settings.safety
    lost = "" if safety is None else lost_at_reboot(str(safety.record_file()))
    return [Finding("event record", "", "", f"warning: {lost}")] if lost else []
