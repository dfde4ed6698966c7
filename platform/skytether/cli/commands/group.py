"""``skytether group``: sites that are made while robots wait, and given back when they are idle."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from .. import names
from ..connection import Json, TokenFile, Url, connected
from ..options import checked, value_of
from ..output import console, fail, or_dash, plain, print_json, print_table, show

if TYPE_CHECKING:
    from skytether.api.groups import Group

app = typer.Typer(help="Groups of sites, whose machines come and go as they are needed.", no_args_is_help=True)

GroupName = Annotated[str, typer.Argument(help="Its name.", autocompletion=names.groups)]
Pairs = list[str] | None


@app.command("list")
def list_groups(url: Url = None, token_file: TokenFile = None, json: Json = False) -> None:
    """List the groups."""
    with connected(url, token_file) as client:
        found = client.groups()
    if json:
        print_json([plain(group) for group in found])
        return
    rows = [
        (g.name, g.provider, g.tier, f"{g.min} to {g.max}", _machines(g), or_dash(g.cpu), f"{g.cost:g}", _why(g))
        for g in found
    ]
    print_table(("group", "provider", "tier", "may have", "machines", "cores each", "cost", "reason"), rows)


def _machines(group: Group) -> str:
    stages = [machine.stage.value for machine in group.machines]
    return ", ".join(f"{stages.count(stage)} {stage}" for stage in dict.fromkeys(stages)) or "none"


def _why(group: Group) -> str:
    again = f" (tried again at {group.retry_at:%H:%M:%S} UTC)" if group.retry_at and group.reason else ""
    return "; ".join(filter(None, ("draining" if group.draining else "", f"{group.reason}{again}")))


@app.command("show")
def show_group(name: GroupName, url: Url = None, token_file: TokenFile = None, json: Json = False) -> None:
    """Show one group: its machines, and what was done last and why."""
    with connected(url, token_file) as client:
        found = client.get_group(name)
    show(found, json)


@app.command("add")
def add_group(
    name: str,
    provider: Annotated[str, typer.Option(help="What makes its machines: local, openstack.")],
    most: Annotated[int, typer.Option("--max", min=1, help="Machines at most.")],
    least: Annotated[int, typer.Option("--min", min=0, help="Machines that are always there.")] = 0,
    tier: Annotated[str, typer.Option(help="robot, edge or cloud.")] = "cloud",
    option: Annotated[Pairs, typer.Option(help="KEY=VALUE of the provider's options; may be given again.")] = None,
    cost: Annotated[float, typer.Option(min=0, help="Of one instance there, for placement.")] = 0.0,
    speed: Annotated[float, typer.Option(min=0.001, help="Of one core, beside the one services are stated for.")] = 1.0,
    image: Annotated[
        Pairs, typer.Option(help="Pattern of images that may run there; may be given again; all else.")
    ] = None,
    label: Annotated[Pairs, typer.Option(help="KEY=VALUE that is noted at each machine; may be given again.")] = None,
    free_cpu: Annotated[float, typer.Option("--free-cpu", min=0, help="Cores that one of its sites keeps free.")] = 0.0,
    free_memory_mb: Annotated[int, typer.Option("--free-memory-mb", min=0, help="MiB that the same keeps free.")] = 0,
    free_share: Annotated[
        float, typer.Option("--free-share", min=0, max=0.99, help="Share of all its cores that is kept free.")
    ] = 0.0,
    grow_after_s: Annotated[
        float, typer.Option(min=0, help="An instance has waited for so long before a machine is made for it.")
    ] = 3.0,
    idle_s: Annotated[float, typer.Option(min=0, help="A machine idle for so long is given back.")] = 600.0,
    join_timeout_s: Annotated[
        float, typer.Option(min=1, help="A machine that is no site by then is destroyed, and made once more.")
    ] = 600.0,
    parallel: Annotated[int, typer.Option(min=1, help="Machines that are made at once, at most.")] = 2,
    url: Url = None,
    token_file: TokenFile = None,
    json: Json = False,
) -> None:
    """Add a group. It makes machines, so only the token in the orchestrator's state folder may."""
    from skytether.api.groups import GroupCreate

    given = {
        "name": name,
        "provider": provider,
        "options": {key: value_of(value) for key, value in _pairs("--option", option)},
        "min": least,
        "max": most,
        "tier": tier,
        "cost": cost,
        "speed": speed,
        "images": tuple(image or ("*",)),
        "labels": dict(_pairs("--label", label)),
        "headroom": {"cpu": free_cpu, "memory_mb": free_memory_mb, "share": free_share},
        "grow_after_s": grow_after_s,
        "idle_s": idle_s,
        "join_timeout_s": join_timeout_s,
        "parallel": parallel,
    }
    request = checked(GroupCreate, given)
    with connected(url, token_file) as client:
        made = client.create_group(request)
    show(made, json)


def _pairs(option: str, given: Pairs) -> list[tuple[str, Any]]:
    pairs = []
    for entry in given or ():
        key, is_, value = entry.partition("=")
        if not is_:
            fail(f"{option} {entry}: write KEY=VALUE", 2)
        pairs.append((key, value))
    return pairs


@app.command("delete")
def delete_group(
    name: GroupName,
    drain: Annotated[
        bool,
        typer.Option(
            "--drain", help="Move what runs there, give all machines back, and go with the last; this cannot be undone."
        ),
    ] = False,
    url: Url = None,
    token_file: TokenFile = None,
) -> None:
    """Forget a group without machines."""
    with connected(url, token_file) as client:
        if not client.delete_group(name, drain=drain):
            console.print(f"group {name} makes no more machines, and is deleted when those it has are given back")
