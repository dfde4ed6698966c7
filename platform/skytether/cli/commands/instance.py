"""``skytether instance``: what runs, for whom."""

from __future__ import annotations

import json as json_module
from typing import Annotated

import typer

from .. import names
from ..connection import Json, TokenFile, Url, connected
from ..names import InstanceId
from ..options import checked
from ..output import console, fail, or_dash, plain, print_foreign, print_json, print_table, show
from ..waiting import until_resized, until_running

app = typer.Typer(help="What runs, for whom.", no_args_is_help=True)

Wait = Annotated[bool, typer.Option(help="Wait until it runs, and show how far it is.")]
Timeout = Annotated[float, typer.Option("--timeout-s", min=0.1, help="How long to wait.")]
_RESUMED = "the orchestrator was away: connected again, the last lines once more"
_TIMEOUT_S = 600.0
"""A large image is pulled in that time."""


@app.command("list")
def list_instances(url: Url = None, token_file: TokenFile = None, json: Json = False) -> None:
    """List the instances, newest first."""
    with connected(url, token_file) as client:
        found = client.instances()
    if json:
        print_json([plain(instance) for instance in found])
        return
    rows = [
        (
            i.id,
            i.robot or "(standby)",
            i.service,
            i.state,
            or_dash(i.placement and i.placement.site),
            i.restarts,
            i.reason,
        )
        for i in found
    ]
    print_table(("instance", "robot", "service", "state", "site", "restarts", "reason"), rows)


@app.command("create")
def create_instance(
    service: Annotated[str, typer.Argument(help="What to run.", autocompletion=names.services)],
    robot: Annotated[str, typer.Option(help="For whom.", autocompletion=names.robots)],
    params: Annotated[str, typer.Option(help="Parameters as a JSON object.")] = "{}",
    lease_s: Annotated[
        float, typer.Option(min=1, max=86_400, help="Ends when not renewed for so many seconds.")
    ] = 3600,
    wait: Wait = True,
    timeout_s: Timeout = _TIMEOUT_S,
    url: Url = None,
    token_file: TokenFile = None,
    json: Json = False,
) -> None:
    """Run a service by hand, for tests; robots ask by themselves."""
    from skytether.api.rest import InstanceCreate

    try:
        values = json_module.loads(params)
    except ValueError as error:
        fail(f"--params is no JSON: {error}", 2)
    asked = {"robot": robot, "service": service, "params": values, "lease_s": lease_s}
    request = checked(InstanceCreate, asked)
    with connected(url, token_file) as client:
        made = client.create_instance(request)
        made = until_running(client, made.id, timeout_s) if wait else made
    show(made, json)


@app.command("show")
def show_instance(instance: InstanceId, url: Url = None, token_file: TokenFile = None, json: Json = False) -> None:
    """Show one instance, but for its session's key."""
    with connected(url, token_file) as client:
        found = client.get_instance(instance)
    show(found, json)


@app.command("logs")
def show_logs(
    instance: InstanceId,
    tail: Annotated[int, typer.Option(min=1, help="Lines.")] = 200,
    follow: Annotated[
        bool, typer.Option("--follow", "-f", help="Of its present run, and what that writes until it ends.")
    ] = False,
    url: Url = None,
    token_file: TokenFile = None,
    json: Json = False,
) -> None:
    """Print what an instance wrote."""
    if follow and json:
        fail("--follow prints as it comes: leave --json out", 2)
    with connected(url, token_file) as client:
        if follow:
            for text in client.follow_logs(instance, tail, lambda: console.print(_RESUMED)):
                print_foreign(text)
            return
        text = client.logs(instance, tail)
    if json:
        print_json({"instance": instance, "lines": text.splitlines()})
    else:
        print_foreign(text)


@app.command("migrate")
def migrate_instance(
    instance: InstanceId,
    site: Annotated[
        str | None,
        typer.Option(help="Where to; without it the best of the other sites.", autocompletion=names.sites),
    ] = None,
    wait: Wait = True,
    timeout_s: Timeout = _TIMEOUT_S,
    url: Url = None,
    token_file: TokenFile = None,
    json: Json = False,
) -> None:
    """Move an instance: another one is started, its robot changes to that, and lets this one go."""
    with connected(url, token_file) as client:
        made = client.migrate_instance(instance, site)
        made = until_running(client, made.id, timeout_s) if wait else made
    show(made, json)


@app.command("resize")
def resize_instance(
    instance: InstanceId,
    cpu: Annotated[float | None, typer.Option(min=0.001, max=10_000, help="Cores.")] = None,
    memory: Annotated[int | None, typer.Option(min=1, max=100_000_000, help="MiB.")] = None,
    wait: Annotated[bool, typer.Option(help="Wait until it has that.")] = True,
    timeout_s: Timeout = 90.0,
    url: Url = None,
    token_file: TokenFile = None,
    json: Json = False,
) -> None:
    """Give a running instance more or less, without a restart.

    Where its site cannot, another one is started that has it, and its robot changes to that.
    """
    from skytether.api.rest import Resize

    if cpu is None and memory is None:
        fail("say what it is to have: --cpu, --memory or both", 2)
    with connected(url, token_file) as client:
        found = client.resize_instance(instance, Resize(cpu=cpu, memory_mb=memory))
        wanted = found.resize or found.size
        found = until_resized(client, instance, timeout_s) if wait else found
    if wait and found.id == instance and found.size != wanted:
        fail(f"it was not given that, and has {found.size}: `skytether instance events {instance}` says why")
    show(found, json)


@app.command("events")
def watch_events(
    instance: InstanceId,
    follow: Annotated[bool, typer.Option("--follow", help="Go on until the instance has ended.")] = False,
    url: Url = None,
    token_file: TokenFile = None,
    json: Json = False,
) -> None:
    """Print what happened to an instance, a line each; with --json a document a line."""
    with connected(url, token_file) as client:
        for event in client.watch(instance, timeout=None if follow else 1.0):
            if json:
                print_json(plain(event))
            else:
                code = f"{event.code}: " if event.code else ""
                line = f"{event.at.isoformat(timespec='milliseconds')}  {event.state}  {code}{event.reason}"
                print_foreign(f"{line.rstrip()}\n")


@app.command("delete")
def delete_instance(instance: InstanceId, url: Url = None, token_file: TokenFile = None) -> None:
    """End an instance."""
    with connected(url, token_file) as client:
        client.delete_instance(instance)
