"""``skytether site list, show, add, delete``: where instances run. Machines that join: `site_nodes`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..connection import Json, TokenFile, Url, connected
from ..names import SiteName
from ..output import console, fail, or_dash, plain, print_json, print_table, show

if TYPE_CHECKING:
    from skytether.api.rest import Site

app = typer.Typer(help="Where instances run.", no_args_is_help=True)


@app.command("list")
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


@app.command("show")
def show_site(name: SiteName, url: Url = None, token_file: TokenFile = None, json: Json = False) -> None:
    """Show one site."""
    with connected(url, token_file) as client:
        found = client.get_site(name)
    show(found, json)


@app.command("add")
def add_site(
    name: str,
    runtime: Annotated[str, typer.Option(help="What starts instances there: process, docker.")],
    tier: Annotated[str, typer.Option(help="robot, edge or cloud.")] = "edge",
    option: Annotated[
        list[str] | None, typer.Option(help="KEY=VALUE of the runtime's options; may be given again.")
    ] = None,
    speed: Annotated[float, typer.Option(min=0.001, help="Of one core, beside the one services are stated for.")] = 1.0,
    cost: Annotated[float, typer.Option(min=0, help="Of one instance, for placement.")] = 0.0,
    image: Annotated[
        list[str] | None, typer.Option(help="Pattern of images that may run there; may be given again; all else.")
    ] = None,
    url: Url = None,
    token_file: TokenFile = None,
    json: Json = False,
) -> None:
    """Add a place where instances run."""
    from pydantic import ValidationError

    from skytether.api.rest import SiteCreate

    asked = {
        "name": name,
        "runtime": runtime,
        "tier": tier,
        "options": options_of(option),
        "speed": speed,
        "cost": cost,
    }
    try:
        request = SiteCreate.model_validate({**asked, "images": tuple(image or ("*",))})
    except ValidationError as error:
        first = error.errors()[0]
        fail(f"{'.'.join(str(p) for p in first['loc'])}: {first['msg'][:1].lower()}{first['msg'][1:]}", 2)
    with connected(url, token_file) as client:
        made = client.create_site(request)
    show(made, json)


def options_of(entries: list[str] | None) -> dict[str, Any]:
    """What ``--option KEY=VALUE`` says."""
    options = {}
    for entry in entries or ():
        key, is_, value = entry.partition("=")
        if not is_:
            fail(f"--option {entry}: write KEY=VALUE", 2)
        options[key] = value_of(value)
    return options


def value_of(text: str) -> Any:
    """A value of an option, as YAML reads it; what is none is text."""
    import yaml

    try:
        return yaml.safe_load(text)
    except yaml.YAMLError:
        return text


@app.command("delete")
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
