"""From which registries this machine's engine may be asked to pull.

An engine asks a registry that is on its own machine without TLS, and its answer to the pull tells some of what it was
told. So an orchestrator could read what programs say that listen on loopback.
"""

from __future__ import annotations

import asyncio
import ipaddress
import socket
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor

from .machine import own_addresses

DOCKER_HUB = "docker.io"


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
        # One thread: names that take for ever to resolve wait for each other, and for nobody else.
        self._resolver = ThreadPoolExecutor(1, thread_name_prefix="registry")

    async def refusal(self, image: str) -> str | None:
        """Why an image is not pulled, in a sentence; None: it may be."""
        registry = registry_of(image)
        if self._named:
            return None if registry in self._named else f"nobody named the registry {registry[:80]} as it joined"
        host = registry.partition(":")[0]
        try:
            async with asyncio.timeout(self._resolve_s):
                found = await asyncio.get_running_loop().run_in_executor(self._resolver, _addresses, host)
        except TimeoutError:
            return f"the registry {registry[:80]} cannot be found in time"
        except (OSError, UnicodeError):
            return None  # nor does the engine find it
        if any(_is_here(address) for address in found):
            return f"the registry {registry[:80]} is this machine: name it as it joins, by --registry"
        return None


def _addresses(host: str) -> set[str]:
    return {str(row[4][0]).partition("%")[0] for row in socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)}


def _is_here(address: str) -> bool:
    """Whether this machine answers there, or its network's own services do (metadata of a cloud)."""
    ip = ipaddress.ip_address(address)
    ip = getattr(ip, "ipv4_mapped", None) or ip
    return ip.is_loopback or ip.is_link_local or ip.is_unspecified or address in own_addresses()
