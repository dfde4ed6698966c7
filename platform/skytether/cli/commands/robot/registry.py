"""``skytether robot list, add, group, delete, stop-afar``: robots as the orchestrator knows them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer
from pydantic import ValidationError

from skytether.api.manifest import NAME
from skytether.api.rest import RobotCreate

from ... import names
from ...connection import Json, TokenFile, Url, connected
from ...names import need
from ...output import console, fail, or_dash, plain, print_json, print_table

if TYPE_CHECKING:
    from datetime import datetime

    from skytether.api.rest import GateReport, StopOrder

_LONGEST_REASON = 200


def list_robots(url: Url = None, token_file: TokenFile = None, json: Json = False) -> None:
    """List the registered robots."""
    with connected(url, token_file) as client:
        found = client.robots()
    if json:
        print_json([plain(robot) for robot in found])
        return
    rows = [
        (
            r.name,
            ", ".join(r.services),
            or_dash(r.group),
            or_dash(r.created_at),
            or_dash(r.last_seen_at),
            f"{r.use.instances} of {r.quota.instances}",
            f"{r.use.cpu:g} of {r.quota.cpu:g}",
            f"{r.use.memory_mb} of {r.quota.memory_mb}",
            f"{r.use.data_mb} of {r.quota.data_mb}",
            f"{r.use.streams} of {r.quota.streams}",
            _gate(r.gate, r.gate_heard_at),
            _stop(r.stop),
        )
        for r in found
    ]
    head = (
        "robot",
        "may ask for",
        "group",
        "registered",
        "last seen",
        "instances",
        "cores",
        "memory MiB",
        "data MiB",
        "streams",
        "gate",
        "stop from afar",
    )
    print_table(head, rows)


def stop_afar(
    name: Annotated[str | None, typer.Argument(help="Its name.", autocompletion=names.robots)] = None,
    everyone: Annotated[bool, typer.Option("--all", help="All registered robots.")] = False,
    reason: Annotated[str, typer.Option(help="For the person who stands before it.")] = "somebody asked for it",
    url: Url = None,
    token_file: TokenFile = None,
    json: Json = False,
) -> None:
    """Order a robot to stop, from anywhere. Only a person beside it can reset it, with `skytether robot reset`.

    It obeys if its robot.yaml says `stop_from_afar: true`, within seconds of hearing of it; `skytether robot list` says
    when it did. Asking again changes nothing.
    """
    if everyone == (name is not None):
        fail("name one robot, or say --all", 2)
    if not 1 <= len(reason) <= _LONGEST_REASON:
        fail(f"--reason: 1 to {_LONGEST_REASON} characters", 2)
    with connected(url, token_file) as client:
        orders = [client.stop_robot(name, reason)] if name is not None else client.stop_robots(reason)
    if json:
        print_json([plain(order) for order in orders])
        return
    rows = [(order.robot, order.reason, or_dash(order.at), or_dash(order.acknowledged_at)) for order in orders]
    print_table(("robot", "reason", "ordered", "acknowledged"), rows)


def _stop(order: StopOrder | None) -> str:
    if order is None:
        return "-"
    if order.acknowledged_at is None:
        return f"ordered {or_dash(order.at)}, not acknowledged: {order.reason}"
    return f"acknowledged {or_dash(order.acknowledged_at)}: {order.reason}"


def _gate(gate: GateReport | None, heard_at: datetime | None) -> str:
    if gate is None:
        return "-" if heard_at is None else f"unknown: not heard of since {or_dash(heard_at)}"
    if not gate.answers:
        return "does not answer"
    return f"stopped: {gate.stopped}" if gate.stopped else f"{gate.hand or 'nobody'} drives, ahead {gate.zone}"


def add_robot(
    name: str,
    service: Annotated[
        list[str] | None,
        typer.Option(help="What it may ask for; may be given again; all else.", autocompletion=names.services),
    ] = None,
    group: Annotated[
        str | None, typer.Option(help="With whose robots its services share what they see; nobody's else.")
    ] = None,
    url: Url = None,
    token_file: TokenFile = None,
    json: Json = False,
) -> None:
    """Register a robot. Its token is printed on standard output, this once."""
    try:
        request = RobotCreate(name=name, services=tuple(service or ("*",)), group=group)
    except ValidationError as error:
        wrong = group if error.errors()[0]["loc"] == ("group",) else name
        fail(f"'{wrong}' is not a valid name: lower-case letters, digits and '-', at most 63", 2)
    with connected(url, token_file) as client:
        made = client.create_robot(request)
    if json:
        print_json(plain(made))
        return
    console.print(f"robot {made.name} is registered; its token, which cannot be shown again:")
    typer.echo(made.token)


def group_robot(
    name: Annotated[str, typer.Argument(help="Its name.", autocompletion=names.robots)],
    group: Annotated[str | None, typer.Argument(help="The group's name; nothing: out of its group.")] = None,
    url: Url = None,
    token_file: TokenFile = None,
) -> None:
    """Say with whose robots its services share what they see: with the same services of all robots of the group."""
    if group is not None and not NAME.fullmatch(group):
        fail(f"'{group}' is not a valid name: lower-case letters, digits and '-', at most 63", 2)
    with connected(url, token_file) as client:
        need("robot", name, lambda: [robot.name for robot in client.robots()])
        client.set_group(name, group)
    console.print(f"robot {name} is in no group" if group is None else f"robot {name} is in group {group}")


def delete_robot(
    name: Annotated[str, typer.Argument(help="Its name.", autocompletion=names.robots)],
    url: Url = None,
    token_file: TokenFile = None,
) -> None:
    """Revoke a robot's token and end what it holds."""
    with connected(url, token_file) as client:
        need("robot", name, lambda: [robot.name for robot in client.robots()])
        client.delete_robot(name)
