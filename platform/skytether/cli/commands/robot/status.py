"""``skytether robot status``: what the agent on this machine does, and why."""

from __future__ import annotations

from typing import Annotated, Any

import httpx
import typer
from rich.table import Table

from skytether.robot.agent.status import ports

from ...connection import Json
from ...output import cell, fail, print_json, print_whole

_TIMEOUT_S = 5.0
_COUNTED = {
    "refused": "refused",
    "dropped": "dropped",
    "sent": "sent",
    "delivered": "delivered",
    "superseded": "old",
    "lost": "lost",
    "unsettled": "open",
}
_ADDS_UP = "published = refused + dropped + sent; sent = delivered + old + lost + open"
_NO_AGENT = "what answers on port {} of this machine is no agent; give its status_port with --port"


def status(
    robot: Annotated[str, typer.Argument(help="Which one, if several have an agent on this machine.")] = "",
    port: Annotated[
        int, typer.Option(min=1, max=65_535, envvar="SKYTETHER_STATUS_PORT", help="status_port of robot.yaml.")
    ] = 8610,
    json: Json = False,
) -> None:
    """Show who drives this robot and why, where its service runs, and what the link is like.

    Asks the agent on this machine (`skytether robot run`), not the orchestrator. An agent whose port was taken
    listens on one of the next; it is found there by the robot's name.
    """
    found = _of(robot, port) if robot else _ask(port)
    if found is None:
        who = f"agent of robot {robot}" if robot else "agent"
        fail(f"no {who} answers on port {port} of this machine; start one with `skytether robot run robot.yaml`")
    if json:
        print_json(found)
        return
    try:
        tables = _tables(found)
    except (ValueError, KeyError, TypeError):
        fail(_NO_AGENT.format(port))
    for table in tables:
        print_whole(table)


def _of(robot: str, port: int) -> dict[str, Any] | None:
    """What the agent of a robot says."""
    for one in ports(port):
        try:
            found = _ask(one)
        except typer.Exit:  # something else has that port
            continue
        if found is not None and found.get("robot") == robot:
            return found
    return None


def _ask(port: int) -> dict[str, Any] | None:
    """What the agent at a port says; None: nobody answers."""
    try:
        answer = httpx.get(f"http://127.0.0.1:{port}/status", timeout=_TIMEOUT_S, trust_env=False)
        answer.raise_for_status()
        found = answer.json()
    except (httpx.TransportError, OSError):
        return None
    except (httpx.HTTPStatusError, ValueError):
        found = None
    if not isinstance(found, dict):
        fail(_NO_AGENT.format(port))
    return found


def _tables(found: dict[str, Any]) -> list[Table]:

    link, task, instance = found["link"], found["task"], found["instance"]
    about = Table(title=cell(f"{found['robot']}: {found['service']}"), show_header=False, title_justify="left")
    rows = [
        ("driven by", f"{found['source']} ({found['why']})"),
        ("velocity", _velocity(found["velocity"])),
        ("task", task["why"] if task else "the service is always asked for"),
        ("service", _instance(instance)),
        ("link", _link(link)),
        ("gate", _gate(found.get("gate"))),
        ("processors", _share(found["robot_load"])),
        ("battery", _share(found["battery"])),
        ("trouble", found["trouble"] or "none"),
    ]
    others = found["other_publishers"]["names"]
    if others:
        rows.append(("wheels", f"others publish their topic too: {', '.join(others)}"))
    for name, value in rows:
        about.add_row(name, cell(value))
    tables = [about]
    if task and task["options"]:
        options = Table("where", "cost", "of which", title="Where it could be done", title_justify="left")
        for option in task["options"]:
            parts = ", ".join(f"{name} {value:.2f}" for name, value in option["parts"].items())
            cost = "-" if option["cost"] is None else f"{option['cost']:.2f}"
            options.add_row(cell(option["name"]), cost, cell(option["refused"] or parts))
        tables.append(options)
    if found["topics"]:
        tables.append(_topics(found["topics"]))
    changes = Table("ago [s]", "driven by", "because", title="Hand-overs", title_justify="left")
    for change in reversed(found["transitions"]):
        changes.add_row(f"{change['ago_s']:.1f}", cell(change["source"]), cell(change["reason"]))
    tables.append(changes)
    return tables


def _topics(topics: list[dict[str, Any]]) -> Table:
    """How each topic stands in the robot's graph, and what became of its messages."""
    from rich.table import Table

    table = Table(title="Topics", title_justify="left", caption=_ADDS_UP, caption_justify="left")
    table.add_column("topic", overflow="fold")
    table.add_column("in the robot's graph", overflow="fold")
    for name in ("Hz", *_COUNTED.values()):
        table.add_column(name, justify="right")
    for topic in topics:
        messages, hz = topic["messages"], topic["hz"]
        counts = ("-" if messages is None else str(messages[name]) for name in _COUNTED)
        table.add_row(cell(topic["topic"]), cell(_stands(topic["graph"])), "-" if hz is None else f"{hz:.1f}", *counts)
    return table


def _stands(graph: dict[str, Any] | None) -> str:
    if graph is None:
        return "-"
    if graph["refused"]:
        return f"not carried: {graph['refused']}"
    verb = "publishes" if graph["way"] == "from" else "listens to"
    if not graph["there"]:
        return f"{graph['name']}: nobody {verb} it yet"
    nodes = ", ".join(graph["nodes"]) or "somebody"
    quality = f" ({graph['quality']})" if graph["quality"] else ""
    dropped = f"; {graph['dropped']} dropped on the way" if graph["dropped"] else ""
    return f"{graph['name']} {graph['way']} {nodes}{quality}{dropped}"


def _instance(instance: dict[str, Any] | None) -> str:
    if instance is None:
        return "none"
    where = f" at {instance['site']}" if instance["site"] else ""
    return f"{instance['id']}: {instance['state']}{where}{', ' + instance['reason'] if instance['reason'] else ''}"


def _link(link: dict[str, Any]) -> str:
    if not link["connected"]:
        return "not connected"
    rtt = "-" if link["rtt_ms"] is None else f"{link['rtt_ms']:.1f} ms"
    return f"round trip {rtt}, lost {_share(link['loss'])}, late {_share(link['late'])}"


def _gate(gate: dict[str, Any] | None) -> str:
    if gate is None:
        return "none: the agent drives the wheels itself"
    if not gate["answers"]:
        return "does not answer"
    if gate["stopped"]:
        return f"stopped: {gate['stopped']}"
    troubles = f", {gate['troubles']} troubles (skytether robot gate-status)" if gate["troubles"] else ""
    return f"{gate['hand'] or 'nobody'} drives, ahead {gate['zone'] or 'unknown'}{troubles}"


def _velocity(velocity: dict[str, float]) -> str:
    return f"{velocity['linear_m_s']:.2f} m/s, {velocity['angular_rad_s']:.2f} rad/s"


def _share(value: float | None) -> str:
    return "-" if value is None else f"{value:.0%}"
