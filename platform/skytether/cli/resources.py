"""``skytether service, site, instance, robot``: small verbs over the REST client."""

from __future__ import annotations

import json as json_module
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Any

import typer

from . import names
from .connection import Json, TokenFile, Url, connected
from .output import console, fail, or_dash, plain, print_foreign, print_json, print_table
from .waiting import until_resized, until_running

if TYPE_CHECKING:
    from datetime import datetime

    from pydantic import BaseModel

    from skytether.api.rest import GateReport, Site, StopOrder

service_app = typer.Typer(help="What robots can ask for.", no_args_is_help=True)
site_app = typer.Typer(help="Where instances run.", no_args_is_help=True)
instance_app = typer.Typer(help="What runs, for whom.", no_args_is_help=True)
robot_app = typer.Typer(help="Who may ask; and what runs on a robot: its agent and its gate.", no_args_is_help=True)

ServiceName = Annotated[str, typer.Argument(help="Its name.", autocompletion=names.services)]
SiteName = Annotated[str, typer.Argument(help="Its name.", autocompletion=names.sites)]
InstanceId = Annotated[str, typer.Argument(help="Its id.", autocompletion=names.instances)]
Wait = Annotated[bool, typer.Option(help="Wait until it runs, and show how far it is.")]
Timeout = Annotated[float, typer.Option("--timeout-s", min=0.1, help="How long to wait.")]
_RESUMED = "the orchestrator was away: connected again, the last lines once more"
_LONGEST_REASON = 200
_TIMEOUT_S = 600.0
"""A large image is pulled in that time."""


@service_app.command("list")
def list_services(url: Url = None, token_file: TokenFile = None, json: Json = False) -> None:
    """List the catalogue."""
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


@service_app.command("show")
def show_service(name: ServiceName, url: Url = None, token_file: TokenFile = None, json: Json = False) -> None:
    """Show a service's manifest."""
    with connected(url, token_file) as client:
        found = client.get_service(name)
    show(found, json)


@service_app.command("delete")
def delete_service(name: ServiceName, url: Url = None, token_file: TokenFile = None) -> None:
    """Remove a service that was applied; its instances run on."""
    with connected(url, token_file) as client:
        need("service", name, lambda: [manifest.metadata.name for manifest in client.services()])
        client.delete_service(name)


@site_app.command("list")
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


@site_app.command("show")
def show_site(name: SiteName, url: Url = None, token_file: TokenFile = None, json: Json = False) -> None:
    """Show one site."""
    with connected(url, token_file) as client:
        found = client.get_site(name)
    show(found, json)


@site_app.command("add")
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


@site_app.command("delete")
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


@instance_app.command("list")
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


@instance_app.command("create")
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
    from pydantic import ValidationError

    from skytether.api.rest import InstanceCreate

    try:
        values = json_module.loads(params)
        request = InstanceCreate(robot=robot, service=service, params=values, lease_s=lease_s)
    except ValidationError as error:
        first = error.errors()[0]
        fail(f"{'.'.join(str(p) for p in first['loc'])}: {first['msg']}", 2)
    except ValueError as error:
        fail(f"--params is no JSON: {error}", 2)
    with connected(url, token_file) as client:
        made = client.create_instance(request)
        made = until_running(client, made.id, timeout_s) if wait else made
    show(made, json)


@instance_app.command("show")
def show_instance(instance: InstanceId, url: Url = None, token_file: TokenFile = None, json: Json = False) -> None:
    """Show one instance, but for its session's key."""
    with connected(url, token_file) as client:
        found = client.get_instance(instance)
    show(found, json)


@instance_app.command("logs")
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


@instance_app.command("migrate")
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


@instance_app.command("resize")
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


@instance_app.command("events")
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


@instance_app.command("delete")
def delete_instance(instance: InstanceId, url: Url = None, token_file: TokenFile = None) -> None:
    """End an instance."""
    with connected(url, token_file) as client:
        client.delete_instance(instance)


@robot_app.command("list")
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


@robot_app.command("stop-afar")
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


@robot_app.command("add")
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
    from pydantic import ValidationError

    from skytether.api.rest import RobotCreate

    try:
        request = RobotCreate(name=name, services=tuple(service or ("*",)), group=group)
    except ValidationError as error:
        wrong = group if error.errors()[0]["loc"] == ("group",) else name
        fail(f"'{wrong}' is no name: lower-case letters, digits and '-', at most 63", 2)
    with connected(url, token_file) as client:
        made = client.create_robot(request)
    if json:
        print_json(plain(made))
        return
    console.print(f"robot {made.name} is registered; its token, which cannot be shown again:")
    typer.echo(made.token)


@robot_app.command("group")
def group_robot(
    name: Annotated[str, typer.Argument(help="Its name.", autocompletion=names.robots)],
    group: Annotated[str | None, typer.Argument(help="The group's name; nothing: out of its group.")] = None,
    url: Url = None,
    token_file: TokenFile = None,
) -> None:
    """Say with whose robots its services share what they see: with the same services of all robots of the group."""
    from skytether.api.manifest import NAME

    if group is not None and not NAME.fullmatch(group):
        fail(f"'{group}' is no name: lower-case letters, digits and '-', at most 63", 2)
    with connected(url, token_file) as client:
        need("robot", name, lambda: [robot.name for robot in client.robots()])
        client.set_group(name, group)
    console.print(f"robot {name} is in no group" if group is None else f"robot {name} is in group {group}")


@robot_app.command("delete")
def delete_robot(
    name: Annotated[str, typer.Argument(help="Its name.", autocompletion=names.robots)],
    url: Url = None,
    token_file: TokenFile = None,
) -> None:
    """Revoke a robot's token and end what it holds."""
    with connected(url, token_file) as client:
        need("robot", name, lambda: [robot.name for robot in client.robots()])
        client.delete_robot(name)


def show(model: BaseModel, json: bool) -> None:
    """All of one thing, as YAML or JSON on standard output."""
    import yaml

    if json:
        print_json(plain(model))
    else:
        typer.echo(yaml.safe_dump(plain(model), sort_keys=False), nl=False)


def need(kind: str, name: str, there: Callable[[], list[str]]) -> None:
    """End with the name that was meant where there is none of this one: a slip must not look like something done.

    ``there`` asks for those there are; a token that may not see them does without.
    """
    from skytether.api.client import ApiError
    from skytether.api.faults import known

    try:
        found = there()
    except ApiError as error:
        if error.problem.status != 403:
            raise
        return
    if name not in found:
        fail(f"there is no {kind} '{name}'; {known(found, name)}")
