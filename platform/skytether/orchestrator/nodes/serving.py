"""An orchestrator with its door for nodes, put together: what a node may ask of its own site."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import contextmanager

from skytether.api.node import Stands

from ..core import Orchestrator
from ..errors import ConflictError, NotFoundError
from .authority import LiveContext
from .door import NodeDoor, echo_answers
from .ways import Ways

ADDRESS = "nodes.address"
"""In the state folder: where nodes connect."""


@contextmanager
def serving_nodes(core: Orchestrator, listener: socket.socket | None) -> Iterator[None]:
    """Serve nodes within it; None: none can join."""
    if listener is None or core.authority is None or core.nodes is None:
        yield
        return
    door = NodeDoor(
        listener,
        LiveContext(core.authority, core.clock),
        core.nodes,
        Ways(core.settings.state_dir / "sites"),
        lambda name: standing(core, name),
        lambda name, force: leave(core, name, force=force),
        core.clock,
    )
    address = core.settings.state_dir / ADDRESS
    host, port = listener.getsockname()[:2]
    core.node_port = port
    core.sites.on_deleted = door.cut
    with door:
        address.write_text(f"https://[{host}]:{port}\n" if ":" in host else f"https://{host}:{port}\n")
        try:
            yield
        finally:
            address.unlink(missing_ok=True)


def standing(core: Orchestrator, name: str, *, look: bool = True) -> Stands:
    """How a node's site is now; ``look``: also whether its echo answers."""
    site = core.sites.find_anew(name)
    node = core.nodes.get(name) if core.nodes is not None else None
    if site is None or node is None:
        return Stands(state="gone")
    unreachable, blocked, total = site.unreachable, site.runtime.blocked(), site.capacity
    host, echo = site.asked.options.get("advertise_host"), node.machine.echo
    return Stands(
        state="unreachable" if unreachable else "blocked" if blocked else "ready",
        reason=(unreachable or blocked)[:2000],
        instances=len(core.store.live_at(name)),
        draining=site.draining or site.evacuating,
        echo=echo_answers(str(host), echo) if look and host and echo else None,
        cpu=total.cpu if total else None,
        memory_mb=total.memory_mb if total else None,
    )


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
    return standing(core, name, look=False)
