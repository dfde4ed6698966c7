"""The instances' network: robots reach them through published ports, and they reach nobody.

A bridge of the engine lets its containers talk to every port of the engine's machine, which may be the orchestrator's.
Only a filter there can prevent that, and only a container can set one on any engine: it runs once, with the network of
the machine and the right to configure it, and ends.
"""

from __future__ import annotations

import hashlib
import logging
from contextlib import suppress

from docker import APIClient
from docker.errors import APIError, NotFound

from ..base import RuntimeFailure
from .engine import Engine, explain, status_of
from .images import ensure_image
from .options import DockerOptions

log = logging.getLogger(__name__)

_OURS = "skytether.io/network"
_GUARD = "skytether.io/guard"
_GUARD_TIMEOUT_S = 30
_LEFT_S = 2 * _GUARD_TIMEOUT_S
"""A container of a guard that is older than another one by so much was left behind: its orchestrator was killed."""


def bridge_of(network: str) -> str:
    """Name of the network's interface on the engine's machine: 15 characters at most."""
    return f"sky-{hashlib.sha256(network.encode()).hexdigest()[:10]}"


def table_of(network: str) -> str:
    """The filter's table."""
    return f"inet skytether_{bridge_of(network)[4:]}"


def rules(network: str) -> str:
    """What the filter is told. Setting it again changes nothing.

    Answers to whom called first are let through: to robots, and to the engine's own proxy of published ports.
    """
    bridge, table = bridge_of(network), table_of(network)
    chains = "".join(
        f"add chain {table} {hook} {{ type filter hook {hook} priority -5; policy accept; }}; "
        f'add rule {table} {hook} iifname "{bridge}" ct state established,related accept; '
        f'add rule {table} {hook} iifname "{bridge}" drop; '
        for hook in ("input", "forward")
    )
    return f"add table {table}; flush table {table}; {chains}"


def ensure_network(engine: Engine, options: DockerOptions) -> None:
    """Have the network, closed off. One that somebody else made is left as it is.

    Raises:
        EngineGoneError: The engine does not answer.
        RuntimeFailure: It cannot be made.
    """
    found = _labels(engine, options.network)
    with engine.asked():
        if found is None:
            try:
                engine.api().create_network(
                    options.network,
                    driver="bridge",
                    check_duplicate=True,
                    labels={_OURS: "closed", "app.kubernetes.io/managed-by": "skytether"},
                    options={
                        "com.docker.network.bridge.name": bridge_of(options.network),
                        "com.docker.network.bridge.enable_icc": "false",
                        "com.docker.network.bridge.enable_ip_masquerade": "false",
                    },
                )
            except Exception as error:
                if status_of(error) != 409:  # another orchestrator was faster
                    raise
    if _OURS in (found if found is not None else _labels(engine, options.network) or {}):
        _guard(engine, options)


def remove_network(engine: Engine, options: DockerOptions) -> None:
    """Remove network and filter, if they are ours and nobody is in there: another site may use the same.

    Raises:
        EngineGoneError: The engine does not answer.
    """
    if _OURS not in (_labels(engine, options.network) or {}):
        return
    with engine.asked():
        try:
            engine.api().remove_network(options.network)
        except APIError as error:
            log.info("network %s stays: %s", options.network, explain(error))
            return
    run_guard(engine, options.guard_image, f"delete table {table_of(options.network)}")


def _labels(engine: Engine, network: str) -> dict[str, str] | None:
    with engine.asked():
        try:
            return dict(engine.api().inspect_network(network)["Labels"] or {})
        except NotFound:
            return None


def _guard(engine: Engine, options: DockerOptions) -> None:
    try:
        image = ensure_image(engine, options, options.guard_image, lambda _: None, by_digest=True)
    except RuntimeFailure as error:
        raise type(error)(
            f"the network of the instances cannot be closed off: {error} "
            "(option 'guard_image'), or name a network of your own (option 'network')"
        ) from error
    said, status = run_guard(engine, image, rules(options.network))
    if status:
        raise RuntimeFailure(f"the network of the instances cannot be closed off: {said.strip() or f'status {status}'}")


def run_guard(engine: Engine, image: str, script: str) -> tuple[str, int]:
    """Let nftables on the engine's machine do what a script says; returns what it said, and its status."""
    body = {
        "Image": image,
        "Entrypoint": ["/usr/sbin/nft"],
        "Cmd": [script],
        "User": "0:0",
        "HostConfig": {
            "NetworkMode": "host",
            "ReadonlyRootfs": True,
            "PidsLimit": 16,
            "Memory": 64 << 20,
            "IpcMode": "none",
            "CapDrop": ["ALL"],
            "CapAdd": ["NET_ADMIN"],
            "SecurityOpt": ["no-new-privileges"],
        },
        "Labels": {_GUARD: "", "app.kubernetes.io/managed-by": "skytether"},
    }
    with engine.asked():
        api = engine.api()
        made = api.create_container_from_config(body)["Id"]
        try:
            _remove_left(api, made)
            api.start(made)
            status = int(api.wait(made, timeout=_GUARD_TIMEOUT_S)["StatusCode"])
            return api.logs(made).decode(errors="replace"), status
        finally:
            api.remove_container(made, force=True)


def _remove_left(api: APIClient, made: str) -> None:
    """Remove what others left behind, and not what another orchestrator is just about to start."""
    rows = api.containers(all=True, filters={"label": [_GUARD]})
    latest = max((row["Created"] for row in rows if row["Id"] == made), default=0) - _LEFT_S
    for row in rows:
        if row["Created"] < latest:
            with suppress(APIError):  # somebody else is at it
                api.remove_container(row["Id"], force=True)
