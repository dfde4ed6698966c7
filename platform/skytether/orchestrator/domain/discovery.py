"""What Prometheus is told to scrape: the orchestrators over one database, in the form of its HTTP service discovery.

Nothing else is reachable for it: a robot's own ``/metrics`` is on the robot's loopback, and what a robot or an instance
measures is exported by the orchestrator that leads.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

from skytether.api.rest import ScrapeTargets

NAME = "skytether"
"""As which an orchestrator's connections are known to the database; its own address follows, if it has one."""
MAX_ADDRESS = 52
"""Characters: PostgreSQL keeps 63 bytes of a connection's name."""
_ADDRESS = re.compile(r"https?://[A-Za-z0-9._\-\[\]:]{1,260}")


def is_address(text: str) -> bool:
    """Whether this is an orchestrator's address that fits into a connection's name."""
    return len(text) <= MAX_ADDRESS and _ADDRESS.fullmatch(text) is not None


def named(address: str | None) -> str:
    """The name of the connections of an orchestrator that is reached at ``address``."""
    return f"{NAME} {address}" if address else NAME


def advertised(names: Iterable[str]) -> set[str]:
    """The addresses in the names of connections; anybody may have named his as he likes."""
    addresses = (name.partition(" ")[2] for name in names if name.startswith(f"{NAME} "))
    return {address for address in addresses if is_address(address)}


def targets(others: Iterable[str], own: str | None, asked: str) -> list[ScrapeTargets]:
    """One group for each orchestrator, in order of their addresses.

    Args:
        others: Addresses of all that are connected to the database, this one's among them.
        own: Where this one is reached; None: where it was asked.
        asked: ``SCHEME://HOST[:PORT]`` of the request. It is the caller's to choose, so what is no address is left out.
    """
    addresses = set(others)
    if own is not None:
        addresses.add(own)
    elif _ADDRESS.fullmatch(asked):
        addresses.add(asked)
    groups = []
    for address in sorted(addresses):
        scheme, _, host = address.partition("://")
        groups.append(ScrapeTargets(targets=(host,), labels={"__scheme__": scheme}))
    return groups
