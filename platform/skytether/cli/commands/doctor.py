"""``skytether doctor``: the usual failures, and what to do about each."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated
from urllib.parse import urlsplit

import typer

from skytether.api.client import addresses
from skytether.api.config_file import ConfigError
from skytether.robot.config.robot_config import load_config, load_token
from skytether.robot.diagnosis import examine
from skytether.robot.diagnosis.doctor import Finding

from ..connection import Json, transport
from ..output import console, fail, print_json
from .robot.check import check_run

if TYPE_CHECKING:
    from skytether.robot.config.robot_config import RobotConfig

_COLOURS = {"ok": "green", "trouble": "red", "skipped": "yellow"}


def doctor(
    config: Annotated[
        Path | None, typer.Argument(help="A robot's robot.yaml: looks at its orchestrator, token, graph and fallback.")
    ] = None,
    url: Annotated[
        str | None, typer.Option(help="Of an orchestrator; without it robot.yaml's.", envvar="SKYTETHER_URL")
    ] = None,
    ca_file: Annotated[
        Path | None, typer.Option(help="PEM file of the certificate's authority.", envvar="SKYTETHER_CA_FILE")
    ] = None,
    echo: Annotated[
        str | None,
        typer.Option(help="HOST:PORT of a `skytether echo` to try UDP with; without it the orchestrator's own."),
    ] = None,
    json: Json = False,
) -> None:
    """Look for what usually goes wrong between a robot and its services, and say what to do.

    Looks at orchestrator, certificate, clock, token, UDP, packet size, NAT, ROS graph, message types, fallback and
    optional parts. Ends with exit status 1 if there is trouble.
    """
    if config is None and url is None and echo is None:
        fail("give a robot.yaml, the address of an orchestrator with --url, or an echo with --echo", 2)
    try:
        findings = list(_examine(config, url, ca_file, echo))
    except ConfigError as error:
        fail(str(error), 2)
    if json:
        print_json([finding.document() for finding in findings])
    else:
        for finding in findings:
            mark = f"[{_COLOURS[finding.state]}]{finding.state:>8}[/]"
            console.print(f"{mark} [bold]{finding.check}[/]: ", end="")
            console.print(finding.says, markup=False, soft_wrap=True)
            if finding.todo:
                console.print(f"         -> {finding.todo}", markup=False, soft_wrap=True)
    if any(finding.state == "trouble" for finding in findings):
        raise typer.Exit(1)


def _examine(config: Path | None, url: str | None, ca_file: Path | None, echo: str | None) -> Iterator[Finding]:

    settings = load_config(config) if config is not None else None
    if settings is not None:
        ca_file = ca_file or settings.ca_file
    address = url or (settings.orchestrator if settings else None)
    yield examine.extras(settings.kind.extras(settings.graph) if settings else [])
    if settings is not None:
        yield examine.own_controller(settings.fallback.name, settings.fallback.options)
    if address is not None:
        for one in addresses(address):
            yield from examine.orchestrator(one, ca_file)
        given: str | None = os.environ.get("SKYTETHER_TOKEN")
        if settings is not None and config is not None:
            try:
                given = load_token(settings, config.parent)
            except ConfigError as error:
                yield _trouble("token", str(error), "mend the file; it is made by: skytether robot add NAME > FILE")
                given = None
        if given:
            allowed = settings.insecure_http if settings and not url else transport(address)["insecure_http"]
            service = settings.service if settings else None
            yield examine.token(address, ca_file, given, service, insecure_http=allowed)
    each = addresses(address) if address is not None else []
    echoes = [_address(echo)] if echo else [where for where in map(_of, each) if where is not None]
    echoes += settings.task.addresses.values() if settings and not echo else ()
    for where in echoes:
        yield from examine.network(*where)
    if settings is not None and config is not None:
        yield from _graph(settings, config.parent, _token(settings, config))


def _graph(settings: RobotConfig, folder: Path, token: str) -> Iterator[Finding]:
    """The robot's graph: whether it is there, and the types of what the service takes and gives."""
    try:
        found = [f for f in check_run(settings, folder, token, "doctor") if f.what != "orchestrator"]
    except ConfigError as error:
        yield _trouble("ros graph", str(error), settings.kind.todo)
        return
    for f in (f for f in found if f.check):
        yield Finding(f.check, "ok" if f.good else "trouble", f.says, "" if f.good else f.todo)
    rest = [f for f in found if not f.check]
    for f in (f for f in rest if not f.good):
        todo = f.todo or f"give {f.where} the type {f.kind}, or name another topic in remap of robot.yaml"
        yield Finding("types" if f.kind else "ros graph", "trouble", f"{f.what} ({f.where}): {f.says}", todo)
    if not all(f.good for f in found):
        return
    if len(rest) == len(found):
        yield Finding("ros graph", "ok", f"{found[0].says}; what goes with the service was looked at")
    elif typed := [f for f in rest if f.kind]:
        yield Finding("types", "ok", f"{len(typed)} topics of the graph go with the service's")


def _trouble(check: str, says: str, todo: str) -> Finding:

    return Finding(check, "trouble", says, todo)


def _token(settings: RobotConfig, config: Path) -> str:

    try:
        return load_token(settings, config.parent)
    except ConfigError:
        return ""  # said before


def _of(url: str) -> tuple[str, int] | None:
    """The orchestrator's own echo: the same host and number."""
    parts = urlsplit(url)
    if not parts.hostname:
        return None
    return parts.hostname, parts.port or (443 if parts.scheme == "https" else 80)


def _address(text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    if not host or not port.isdigit() or not 0 < int(port) < 65_536:
        fail(f"--echo must be HOST:PORT, not {text}", 2)
    return host.strip("[]"), int(port)
