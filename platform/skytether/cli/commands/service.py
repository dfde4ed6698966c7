"""``skytether service``: what robots can ask for."""

from __future__ import annotations

import typer

from ..connection import Json, TokenFile, Url, connected
from ..names import ServiceName, need
from ..output import print_json, print_table, show

app = typer.Typer(help="What robots can ask for.", no_args_is_help=True)


@app.command("list")
def list_services(url: Url = None, token_file: TokenFile = None, json: Json = False) -> None:
    """List the catalog."""
    with connected(url, token_file) as client:
        found = client.services()
    if json:
        print_json([manifest.model_dump(mode="json", by_alias=True) for manifest in found])
        return
    rows = [
        (m.metadata.name, m.metadata.version, ", ".join(m.spec.needs.tiers), " ".join(t.name for t in m.spec.topics))
        for m in found
    ]
    print_table(("service", "version", "tiers", "topics"), rows)


@app.command("show")
def show_service(name: ServiceName, url: Url = None, token_file: TokenFile = None, json: Json = False) -> None:
    """Show a service's manifest."""
    with connected(url, token_file) as client:
        found = client.get_service(name)
    show(found, json)


@app.command("delete")
def delete_service(name: ServiceName, url: Url = None, token_file: TokenFile = None) -> None:
    """Remove a service that was applied; its instances run on."""
    with connected(url, token_file) as client:
        need("service", name, lambda: [manifest.metadata.name for manifest in client.services()])
        client.delete_service(name)
