"""``skytether relay``: one public UDP port for many sessions."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from skytether.api.config_file import ConfigError, check_config, read_config
from skytether.bridge.endpoint import BridgeError
from skytether.bridge.relay import Relay, show_address
from skytether.bridge.relay_config import RelayConfig, parse_endpoint
from skytether.orchestrator.runtimes.base import RuntimeFailure

from ..end_signal import EndSignal
from ..output import console, fail, print_json

if TYPE_CHECKING:
    from skytether.bridge.relay import RelayStats
    from skytether.bridge.relay_config import PodsConfig
    from skytether.orchestrator.runtimes.kubernetes.relayed import PodRoutes


def relay(
    config: Annotated[Path | None, typer.Option(help="YAML: listen, routes, upstream, kubernetes, limits.")] = None,
    listen: Annotated[
        str | None, typer.Option(metavar="HOST:PORT", help="Public UDP port; 0.0.0.0:0 unless given.")
    ] = None,
    route: Annotated[
        list[str] | None,
        typer.Option(metavar="ID=HOST:PORT", help="Where a session goes: its 16 digits, or its first ones and '*'."),
    ] = None,
    upstream: Annotated[str | None, typer.Option(metavar="HOST:PORT", help="Where all other sessions go.")] = None,
    kubernetes: Annotated[
        str | None,
        typer.Option(metavar="NAMESPACE", help="Sessions of pods there go to these, in the relay's cluster."),
    ] = None,
    seconds: Annotated[float | None, typer.Option(min=0.1, help="End after this long; without it at Ctrl-C.")] = None,
    json: Annotated[bool, typer.Option("--json", help="Each second one JSON document on standard output.")] = False,
) -> None:
    """Forward bridge sessions by their id, without a key: one public port for many services, or hop by hop.

    Robots name the relay as their peer. It can neither read nor alter what it forwards.
    """
    try:
        if config is None:
            settings = _from_options(listen, route or [], upstream, kubernetes)
        elif listen or route or upstream or kubernetes:
            fail("give either --config or --listen, --route, --upstream and --kubernetes", 2)
        else:
            settings = read_config(config, RelayConfig)
    except ConfigError as error:
        fail(str(error), 2)
    _run(settings, seconds, as_json=json)


def _from_options(listen: str | None, routes: list[str], upstream: str | None, kubernetes: str | None) -> RelayConfig:

    document: dict[str, Any] = {"routes": []}
    if listen is not None:
        document["listen"] = _endpoint(parse_endpoint(listen, "--listen"))
    for text in routes:
        sessions, _, target = text.partition("=")
        document["routes"].append({"id": sessions, "target": _endpoint(parse_endpoint(target, f"--route {sessions}"))})
    if upstream is not None:
        document["upstream"] = _endpoint(parse_endpoint(upstream, "--upstream"))
    if kubernetes is not None:
        document["kubernetes"] = {"namespace": kubernetes}
    return check_config(document, RelayConfig, "options")


def _endpoint(address: tuple[str, int]) -> dict[str, Any]:
    return {"host": address[0], "port": address[1]}


def _run(settings: RelayConfig, seconds: float | None, *, as_json: bool) -> None:
    end = EndSignal()
    here = Relay((settings.listen.host, settings.listen.port), limits=settings.bounds)
    try:
        here.start()
        for sessions, target in settings.targets:
            here.add(sessions, target.host, target.port)
    except BridgeError as error:
        here.stop()
        fail(f"{error}; change listen, routes or upstream")
    pods = _pods(settings.kubernetes, here) if settings.kubernetes is not None else None
    console.print(f"relay: listens on UDP {show_address(*here.address)}", markup=False, soft_wrap=True)
    start = time.monotonic()
    before = ""
    try:
        while not end.came and (left := _left(start, seconds)) > 0:
            end.wait(min(1.0, left))
            stats = here.stats()
            if as_json:
                print_json({"seconds": round(time.monotonic() - start, 3), **dataclasses.asdict(stats)})
            elif (now := _sentence(stats)) != before:
                console.print(now, markup=False, soft_wrap=True)
                before = now
    finally:
        if pods is not None:
            pods.close()
        here.stop()


def _pods(config: PodsConfig, relay: Relay) -> PodRoutes:
    """Have the relay's routes follow a cluster's pods."""
    try:
        import kubernetes  # noqa: F401 - told apart from an ImportError of our own
    except ImportError:
        relay.stop()
        fail("pods of a cluster need the extra 'kubernetes': pip install 'skytether[kubernetes]'", 2)
    from skytether.orchestrator.runtimes.kubernetes.options import KubernetesOptions
    from skytether.orchestrator.runtimes.kubernetes.relayed import PodRoutes

    try:
        options = check_config(config.model_dump(exclude={"owner"}), KubernetesOptions, "kubernetes")
        pods = PodRoutes(options, config.owner, relay.add, relay.remove)
    except (ConfigError, RuntimeFailure) as error:
        relay.stop()
        fail(str(error), 2)
    pods.start()
    return pods


def _left(start: float, seconds: float | None) -> float:
    return float("inf") if seconds is None else start + seconds - time.monotonic()


def _sentence(stats: RelayStats) -> str:
    """What changes rarely, for people."""
    dropped = ", ".join(f"{name} {count}" for name, count in sorted(stats.rejected.items()))
    return f"{len(stats.sessions)} sessions, {stats.legs} addresses; packets dropped: {dropped or 'none'}"
