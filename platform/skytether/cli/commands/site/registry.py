"""``skytether site list, show, add, delete, invite``: sites as the orchestrator knows them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from ...connection import Json, TokenFile, Url, connected
from ...names import SiteName
from ...options import checked, options_of
from ...output import console, fail, or_dash, plain, print_json, print_table, show

if TYPE_CHECKING:
    from skytether.api.rest import Site

Speed = Annotated[float, typer.Option(min=0.001, help="Of one core, beside the one services are stated for.")]
Cost = Annotated[float, typer.Option(min=0, help="Of one instance, for placement.")]
Images = Annotated[
    list[str] | None, typer.Option(help="Pattern of images that may run there; may be given again; all else.")
]
_UNITS = {"s": 1.0, "m": 60.0, "h": 3600.0}
_LONGEST_S = 86_400.0


def list_sites(url: Url = None, token_file: TokenFile = None, json: Json = False) -> None:
    """List the sites."""
    with connected(url, token_file) as client:
        found = client.sites()
    if json:
        print_json([plain(site) for site in found])
        return
    rows = [
        (s.name, s.tier, s.runtime, s.state, or_dash(s.cpu), or_dash(s.memory_mb), s.instances, _why(s)) for s in found
    ]
    print_table(("site", "tier", "runtime", "state", "cores", "MiB", "instances", "reason"), rows)


def _why(site: Site) -> str:
    """What is wrong with a site: with all of it, or with single services there."""
    state = "draining" if site.draining else "being drained" if site.evacuating else ""
    unfit = (f"no {u.service} before {u.until:%H:%M:%S} UTC: the service {u.reason}" for u in site.unfit)
    return "; ".join(filter(None, (state, site.reason, *unfit)))


def show_site(name: SiteName, url: Url = None, token_file: TokenFile = None, json: Json = False) -> None:
    """Show one site."""
    with connected(url, token_file) as client:
        found = client.get_site(name)
    show(found, json)


def add_site(
    name: str,
    runtime: Annotated[
        str, typer.Option(help="What starts instances there: process, docker, kubernetes, or one that is installed.")
    ],
    tier: Annotated[str, typer.Option(help="robot, edge or cloud.")] = "edge",
    option: Annotated[
        list[str] | None, typer.Option(help="KEY=VALUE of the runtime's options; may be given again.")
    ] = None,
    speed: Speed = 1.0,
    cost: Cost = 0.0,
    image: Images = None,
    url: Url = None,
    token_file: TokenFile = None,
    json: Json = False,
) -> None:
    """Add a place where instances run."""
    from skytether.api.rest import SiteCreate

    asked = {
        "name": name,
        "runtime": runtime,
        "tier": tier,
        "options": options_of(option),
        "speed": speed,
        "cost": cost,
    }
    request = checked(SiteCreate, {**asked, "images": tuple(image or ("*",))})
    with connected(url, token_file) as client:
        made = client.create_site(request)
    show(made, json)


def delete_site(
    name: SiteName,
    drain: Annotated[
        bool, typer.Option("--drain", help="Take no more instances, and go with the last one; this cannot be undone.")
    ] = False,
    url: Url = None,
    token_file: TokenFile = None,
) -> None:
    """Forget a site that has no instances."""
    with connected(url, token_file) as client:
        if not client.delete_site(name, drain=drain):
            console.print(f"site {name} takes no more instances, and is deleted when those that are there have ended")


def invite_node(
    name: Annotated[str, typer.Argument(help="Of the site that the machine will be.")],
    tier: Annotated[str, typer.Option(help="edge or cloud.")] = "edge",
    valid: Annotated[
        str, typer.Option(help="How long the token is good for, such as 30m or 1h; a day at most.")
    ] = "1h",
    option: Annotated[
        list[str] | None,
        typer.Option(
            help="KEY=VALUE of the Docker runtime's options; may be given again. It goes before the machine's."
        ),
    ] = None,
    speed: Speed = 1.0,
    cost: Cost = 0.0,
    image: Images = None,
    url: Url = None,
    token_file: TokenFile = None,
    json: Json = False,
) -> None:
    """Make a token with which one machine may join, once. It is printed on standard output, this once.

    With it goes the fingerprint of the key by which the machine knows the orchestrator. A token for the same name that
    was not used is worth nothing any more.
    """
    from skytether.api.rest import Invite

    asked = {"name": name, "tier": tier, "options": options_of(option), "speed": speed, "cost": cost}
    request = checked(Invite, {**asked, "images": tuple(image or ("*",)), "ttl_s": _seconds(valid)})
    with connected(url, token_file) as client:
        made = client.invite(request)
    if json:
        print_json(plain(made))
        return
    where = ",".join(made.urls) or f"https://ORCHESTRATOR:{made.port}"
    console.print(
        f"on the machine that is to be site {made.name}, before {made.expires_at:%Y-%m-%d %H:%M:%S} UTC:", markup=False
    )
    console.print(f"  skytether site join {where} --token-file -", markup=False, soft_wrap=True)
    console.print("with this token, which cannot be shown again:", markup=False)
    typer.echo(made.token)


def _seconds(text: str) -> float:
    unit = _UNITS.get(text[-1:].lower())
    try:
        seconds = float(text[:-1] if unit else text) * (unit or 1.0)
    except ValueError:
        seconds = 0.0
    if not 1 <= seconds <= _LONGEST_S:
        fail(f"--valid {text}: write 90s, 30m or 1h; 24h at most", 2)
    return seconds
