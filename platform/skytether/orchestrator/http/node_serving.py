"""An orchestrator with its door for nodes, put together: what a node may ask of its own site."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import contextmanager

from skytether.api.node import Stands

from ..core import Orchestrator
from ..domain.errors import ConflictError, NotFoundError
from ..nodes.authority import LiveContext
from ..nodes.ways import Ways
from .node_listener import NodeListener

ADDRESS = "nodes.address"
"""In the state folder: where nodes connect."""


@contextmanager
def serving_nodes(core: Orchestrator, listener: socket.socket | None) -> Iterator[None]:
    """Serve nodes within it; None: none can join."""
    if listener is None or core.authority is None or core.nodes is None:
        yield
        return
    door = NodeListener(
        listener,
        LiveContext(core.authority, core.clock),
        core.nodes,
        Ways(core.settings.state_dir / "sites"),
        lambda name: standing(core, name),
        lambda name: echo_of(core, name),
        lambda name, force: leave(core, name, force=force),
        core.clock,
    )
    address = core.settings.state_dir / ADDRESS
    host, port = listener.getsockname()[:2]
    core.node_port = port
    core.sites.subscribe_deletions(door.cut)
    with door:
        address.write_text(f"https://[{host}]:{port}\n" if ":" in host else f"https://{host}:{port}\n")
        try:
            yield
        finally:
            address.unlink(missing_ok=True)


def standing(core: Orchestrator, name: str) -> Stands:
    """How a node's site is now."""
    site = core.sites.find_anew(name)
    node = core.nodes.get(name) if core.nodes is not None else None
    if site is None or node is None:
        return Stands(state="gone")
    unreachable, blocked, total = site.unreachable, site.runtime.blocked(), site.capacity
    return Stands(
        state="unreachable" if unreachable else "blocked" if blocked else "ready",
        reason=(unreachable or blocked)[:2000],
        instances=len(core.store.live_at(name)),
        draining=site.draining or site.evacuating,
        cpu=total.cpu if total else None,
        memory_mb=total.memory_mb if total else None,
    )


def echo_of(core: Orchestrator, name: str) -> tuple[str, int] | None:
    """Where a node says that its echo answers; None: it says nothing."""
    site = core.sites.find(name)
    node = core.nodes.get(name) if core.nodes is not None and site is not None else None
    host = site.asked.options.get("advertise_host") if site is not None else None
    return (str(host), node.machine.echo) if host and node is not None and node.machine.echo else None


def leave(core: Orchestrator, name: str, *, force: bool) -> Stands:
    """Have a site end: at once, or as soon as what runs there was moved, or has ended."""
    try:
        if force:
            core.sites.delete(name, force=True)
            gone = True
        else:
            core.sites.evacuate(name)
            gone = core.sites.drain(name)
    except (NotFoundError, ConflictError):  # it is gone already, or something was just started there
        gone = core.sites.find_anew(name) is None
    if gone:
        core.metrics.forget_site(name)
        return Stands(state="gone")
    return standing(core, name)
