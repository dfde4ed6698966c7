"""The instances' network: robots reach them through published ports, and they reach nobody but what their site opens.

What an instance may begin is filtered in its own network namespace, where no reload of the machine's firewall gets to,
and which it has no right to configure. That is made without a network; a container of the guard's image, which shares
that namespace and nothing else with the machine, sets the filter and ends; then the network is connected. So nothing
has any right to the machine's own network, and an instance whose filter could not be set has none.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Iterable, Mapping

from docker.errors import APIError, NotFound

from skytether.api.manifest import Opening

from ..base import RuntimeFailure
from .engine import Engine, explain, status_of
from .images import ensure_image
from .objects import guard
from .options import DockerOptions

log = logging.getLogger(__name__)

_OURS = "skytether.io/network"
_FILTERED = "filtered"
"""The label's value; networks of earlier releases have another, and a filter on the engine's machine."""
_OLD_GUARD = "skytether.io/guard"
_GUARD_TIMEOUT_S = 30
_TABLE = "inet skytether"
_NAME_SERVER, _NAMES = "127.0.0.11", 53
"""Where a Docker engine answers for names in each network that is not its own, and the port that is asked."""


def remove_old_guards(engine: Engine) -> None:
    """Remove what guards of earlier releases left, whose labels name no owner, where a killed orchestrator began them.

    Raises:
        RuntimeFailure: The engine does not answer, or is just removing what it does not need.
    """
    with engine.asked():
        # An orchestrator of such a release may have another one at work.
        engine.api().prune_containers({"label": [_OLD_GUARD], "until": f"{2 * _GUARD_TIMEOUT_S}s"})


def bridge_of(network: str) -> str:
    """Name of the network's interface on the engine's machine: 15 characters at most."""
    return f"skt-{hashlib.sha256(network.encode()).hexdigest()[:10]}"


def rules(openings: Mapping[Opening, Iterable[str]]) -> str:
    """What the filter of one instance is told.

    Answers to whom called first are let through: to robots, and to the engine's own proxy of published ports.

    The engine has a name server of its own within, at `_NAME_SERVER`, which runs outside and knows the names of all
    others in the network. It is asked through a translated port: what is not tracked is not translated, so that whoever
    asks is told at once that nobody is there. What a service sends to itself would otherwise also fill the kernel's
    table of connections, of which no limit of its container knows.

    Args:
        openings: What it may begin, with the addresses of each.
    """
    allowed = [
        f"{'ip6' if ':' in address else 'ip'} daddr {address} {opening.protocol} dport {opening.port} accept"
        for opening, addresses in openings.items()
        for address in addresses
    ]
    neighbours = "icmpv6 type { nd-neighbor-solicit, nd-neighbor-advert } accept"
    no_names = f"ip daddr {_NAME_SERVER} meta l4proto {{ tcp, udp }} th dport != {_NAMES} drop"
    always = [no_names, 'oifname "lo" accept', "ct state established,related accept", neighbours]
    chain = f"add chain {_TABLE} output {{ type filter hook output priority 0; policy drop; }}"
    early = f"add chain {_TABLE} untracked {{ type filter hook output priority -300; }}"
    own = f'add rule {_TABLE} untracked oifname "lo" notrack'
    added = "".join(f"add rule {_TABLE} output {rule}; " for rule in (*always, *allowed))
    return f"add table {_TABLE}; {chain}; {early}; {own}; {added}"


def ensure_network(engine: Engine, options: DockerOptions) -> None:
    """Have the network, and what its instances are closed off with. One that somebody else made is left as it is.

    Raises:
        EngineGoneError: The engine does not answer.
        RuntimeFailure: It cannot be made.
    """
    found = _labels(engine, options.network)
    if found is not None and found.get(_OURS, _FILTERED) != _FILTERED:
        found = _labels(engine, options.network) if not _removed(engine, options.network) else None
    with engine.asked():
        if found is None:
            try:
                engine.api().create_network(
                    options.network,
                    driver="bridge",
                    check_duplicate=True,
                    labels={_OURS: _FILTERED, "app.kubernetes.io/managed-by": "skytether"},
                    options={
                        "com.docker.network.bridge.name": bridge_of(options.network),
                        "com.docker.network.bridge.enable_icc": "false",
                    },
                )
            except Exception as error:
                if status_of(error) != 409:  # another orchestrator was faster
                    raise
    if is_ours(engine, options.network):
        guard_image(engine, options)


def is_ours(engine: Engine, network: str) -> bool:
    """Whether instances there are to be closed off; also while it is not there, for it would be made.

    Raises:
        EngineGoneError: The engine does not answer.
    """
    labels = _labels(engine, network)
    return labels is None or _OURS in labels


def remove_network(engine: Engine, options: DockerOptions) -> None:
    """Remove the network, if it is ours and nobody is in there: another site may use the same.

    Raises:
        EngineGoneError: The engine does not answer.
    """
    if is_ours(engine, options.network):
        _removed(engine, options.network)


def _removed(engine: Engine, network: str) -> bool:
    with engine.asked():
        try:
            engine.api().remove_network(network)
        except APIError as error:
            log.info("network %s stays: %s", network, explain(error))
            return False
    return True


def _labels(engine: Engine, network: str) -> dict[str, str] | None:
    with engine.asked():
        try:
            return dict(engine.api().inspect_network(network)["Labels"] or {})
        except NotFound:
            return None


def guard_image(engine: Engine, options: DockerOptions) -> str:
    """The id of the guard's image, which is on the engine.

    Raises:
        EngineGoneError: The engine does not answer.
        RuntimeFailure: It is missing.
    """
    try:
        return ensure_image(engine, options, options.guard_image, lambda _: None, by_digest=True)
    except RuntimeFailure as error:
        raise type(error)(
            f"the network of the instances cannot be closed off: {error} "
            "(option 'guard_image'), or name a network of your own (option 'network')"
        ) from error


def close_off(
    engine: Engine,
    options: DockerOptions,
    owner: str,
    image: str,
    container: str,
    openings: Mapping[Opening, Iterable[str]],
) -> None:
    """Set the filter of a container that runs, and is not connected to any network yet.

    Raises:
        EngineGoneError: The engine does not answer.
        RuntimeFailure: It was not set.
    """
    body = guard(options, owner, image, container, rules(openings))
    with engine.asked():
        api = engine.api()
        made = api.create_container_from_config(body)["Id"]
        try:
            api.start(made)
            status = int(api.wait(made, timeout=_GUARD_TIMEOUT_S)["StatusCode"])
            said = api.logs(made).decode(errors="replace") if status else ""
        finally:
            api.remove_container(made, force=True)
    if status:
        raise RuntimeFailure(f"the network of the instances cannot be closed off: {said.strip() or f'status {status}'}")
