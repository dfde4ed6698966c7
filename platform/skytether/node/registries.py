"""From which registries this machine's engine may be asked to pull.

An engine asks a registry that is on its own machine without TLS, and its answer to the pull tells some of what it was
told. So an orchestrator could read what programs say that listen on loopback.
"""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
from collections.abc import Iterable

from .machine import own_addresses
from .names import Names

DOCKER_HUB = "docker.io"
_MOST, _MOST_OF_DOMAIN = 32, 2
"""Names that are resolved at a time, and of one domain: those that take for ever wait for each other, and for few
else."""
_MOST_KNOWN = 256


def registry_of(image: str) -> str:
    """``HOST[:PORT]`` from which an engine pulls an image of this name."""
    first, rest = image.partition("/")[::2]
    # Repositories are lower case, so newer engines (distribution's reference, splitDockerDomain) take anything else for
    # a host: LOCALHOST is this machine.
    is_host = "." in first or ":" in first or first == "localhost" or first != first.lower()
    return first if rest and is_host else DOCKER_HUB


class Registries:
    """Judges pulls.

    Args:
        named: The only ones, as ``HOST[:PORT]``; empty: any that is not this machine itself.
        resolve_s: For a name to be resolved.
    """

    def __init__(self, named: Iterable[str] = (), resolve_s: float = 5.0) -> None:
        self._named = frozenset(named)
        self._resolve_s = resolve_s
        self._names = Names(_MOST)
        self._elsewhere: dict[str, None] = {}
        """Hosts that were found last not to be this machine, those of late at the end."""

    async def refusal(self, image: str) -> str | None:
        """Why an image is not pulled, in a sentence; None: it may be."""
        registry = registry_of(image)
        if self._named:
            return None if registry in self._named else f"nobody named the registry {registry[:80]} as it joined"
        host = registry.partition(":")[0]
        try:
            found = await self._find(host)
        except TimeoutError:
            # A name server that does not answer for names of somebody's is asked for no known one's either.
            return None if host in self._elsewhere else f"the registry {registry[:80]} cannot be found in time"
        except (OSError, UnicodeError):
            return None  # nor does the engine find it
        self._elsewhere.pop(host, None)
        if any(_is_here(address) for address in found):
            return f"the registry {registry[:80]} is this machine: name it as it joins, by --registry"
        self._elsewhere[host] = None
        while len(self._elsewhere) > _MOST_KNOWN:
            del self._elsewhere[next(iter(self._elsewhere))]
        return None

    async def _find(self, host: str) -> list[str]:
        with contextlib.suppress(ValueError):
            return [str(ipaddress.ip_address(host))]
        domain, others = _domain(host), self._names.asked - {host}
        if len(others) >= _MOST or sum(_domain(name) == domain for name in others) >= _MOST_OF_DOMAIN:
            raise TimeoutError  # rather than wait behind those
        async with asyncio.timeout(self._resolve_s):
            return [address.partition("%")[0] for address in await self._names.find(host)]


def _domain(host: str) -> str:
    """What somebody has all names below."""
    return ".".join(host.lower().rstrip(".").split(".")[-2:])


def _is_here(address: str) -> bool:
    """Whether this machine answers there, or its network's own services do (metadata of a cloud)."""
    ip = ipaddress.ip_address(address)
    ip = getattr(ip, "ipv4_mapped", None) or ip
    return ip.is_loopback or ip.is_link_local or ip.is_unspecified or address in own_addresses()
