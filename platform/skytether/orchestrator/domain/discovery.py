"""What Prometheus is told to scrape: the orchestrators over one database, in the form of its HTTP service discovery.

Nothing else is reachable for it: a robot's own ``/metrics`` is on the robot's loopback, and what a robot or an instance
measures is exported by the orchestrator that leads.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

from skytether.api.rest import ScrapeTargets

_ADDRESS = re.compile(r"https?://[A-Za-z0-9._\-\[\]:]{1,260}")


def is_address(text: str) -> bool:
    """Whether this is an orchestrator's address."""
    return _ADDRESS.fullmatch(text) is not None


def targets(others: Iterable[str], own: str | None, asked: str) -> list[ScrapeTargets]:
    """One group for each orchestrator, in order of their addresses.

    Args:
        others: Addresses of all over the database, this one's among them.
        own: Where this one is reached; None: where it was asked.
        asked: ``SCHEME://HOST[:PORT]`` of the request. It is the caller's to choose, so what is no address is left out.
    """
    addresses = set(filter(is_address, others))
    if own is not None:
        addresses.add(own)
    elif is_address(asked):
        addresses.add(asked)
    groups = []
    for address in sorted(addresses):
        scheme, _, host = address.partition("://")
        groups.append(ScrapeTargets(targets=(host,), labels={"__scheme__": scheme}))
    return groups
