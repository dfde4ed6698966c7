"""What a site lets its services connect to: patterns of its operator, held against what a manifest asks for.

Whoever writes manifests need not be the operator. So an address is compared as a number, and never as text:
``192.0.2.0/0`` begins like ``192.0.2.*``, and so does a name that somebody else owns.
"""

from __future__ import annotations

import ipaddress
import re
import socket
import threading
import time
from collections.abc import Iterable
from fnmatch import fnmatchcase
from typing import NamedTuple

from skytether.api.manifest import Opening

from .base import RuntimeFailure

Network = ipaddress.IPv4Network | ipaddress.IPv6Network
_NUMBER = re.compile(r"([0-9]+|0x[0-9a-f]*)")
"""The last label of what a resolver takes for an address, however it is written: 127.1, 0x7f000001."""
_BYTES, _BITS = 4, 8
_LOOK_UP_S = 15.0
"""For all names of one start; what is asked for again is in the name server's memory then."""


class _Pattern(NamedTuple):
    """Its parts; one that was left out is ``*``."""

    host: str
    port: str
    protocol: str
    numbers: bool
    """It is for addresses, and for no name."""

    @classmethod
    def of(cls, text: str) -> _Pattern:
        text = text.lower()
        address, _, protocol = text.rpartition("/") if text.endswith(("/tcp", "/udp", "/*")) else (text, "", "")
        host, _, port = address.partition(":")
        numbers = re.fullmatch(r"[0-9.*?/]*[0-9][0-9.*?/]*", host) is not None
        if address.startswith("[") and ":" in address.partition("]")[0]:  # and not [ab].example.org
            host, _, port = address[1:].partition("]")
            port, numbers = port.removeprefix(":"), True
        return cls(host, port or "*", protocol or "*", numbers)

    def lets(self, opening: Opening, wanted: Network | None) -> bool:
        if not (fnmatchcase(str(opening.port), self.port) and fnmatchcase(opening.protocol, self.protocol)):
            return False
        if self.host == "*":
            return True
        if wanted is None or not self.numbers:
            return wanted is None and not self.numbers and fnmatchcase(opening.host, self.host)
        network = _network(self.host)
        if network is not None:
            return _within(wanted, network)
        # What is no network (10.0.?.7) is held against single addresses, each of which has one way to be written.
        return wanted.num_addresses == 1 and fnmatchcase(str(wanted.network_address), self.host)


def _network(pattern: str) -> Network | None:
    """What a pattern of numbers stands for as a whole: 192.0.2.* is 192.0.2.0/24; None: it is no network."""
    given = pattern.split(".")
    known = [part for part in given if part != "*"]
    if len(given) <= _BYTES and given[-1] == "*" and "*" not in given[: len(known)]:
        pattern = f"{'.'.join(known + ['0'] * (_BYTES - len(known)))}/{len(known) * _BITS}"
    try:
        return ipaddress.ip_network(pattern)
    except ValueError:
        return None


def _within(wanted: Network, network: Network) -> bool:
    if isinstance(wanted, ipaddress.IPv4Network):
        return isinstance(network, ipaddress.IPv4Network) and wanted.subnet_of(network)
    return isinstance(network, ipaddress.IPv6Network) and wanted.subnet_of(network)


def network_of(opening: Opening) -> Network | None:
    """The address or network that is asked for; None: it is a name.

    Raises:
        ValueError: It can be read in two ways: a network with an address of a machine, a number that is no address.
    """
    host = opening.host
    try:
        return ipaddress.ip_network(host)
    except ValueError:
        if "/" in host or ":" in host or _NUMBER.fullmatch(host.rstrip(".").rpartition(".")[2]):
            raise
        return None


def refusal_of(openings: Iterable[Opening], patterns: Iterable[str]) -> str | None:
    """Why a site with these patterns does not open all that; None: it does."""
    allowed = [_Pattern.of(text) for text in patterns]
    closed = []
    for opening in openings:
        try:
            wanted = network_of(opening)
        except ValueError as error:
            return f"nobody can connect to {opening}: {error}"
        if not any(pattern.lets(opening, wanted) for pattern in allowed):
            closed.append(str(opening))
    if closed:
        return f"the site lets nobody connect to {', '.join(closed)}: add it to the site's option 'egress'"
    return None


def resolve(openings: Iterable[Opening], within_s: float = _LOOK_UP_S) -> dict[Opening, tuple[str, ...]]:
    """The addresses of what is opened, as they are now: an instance keeps these, and has nobody to ask for others.

    Those of a network, or of an address, are written with their prefix; those of a name are not.

    Args:
        openings: What is opened.
        within_s: How long the names in it may take, all together [s].

    Raises:
        RuntimeFailure: A name has none, or nobody said so in time, or it is neither name nor address.
    """
    found: dict[Opening, tuple[str, ...]] = {}
    names: list[Opening] = []
    for opening in openings:
        try:
            network = network_of(opening)
        except ValueError as error:
            raise RuntimeFailure(f"needs.egress: {opening}: {error}") from error
        if network is not None:
            found[opening] = (str(network),)
            continue
        names.append(opening)
    known = _look_up(dict.fromkeys(opening.host for opening in names), within_s) if names else {}
    return found | {opening: known[opening.host] for opening in names}


def _look_up(names: Iterable[str], within_s: float) -> dict[str, tuple[str, ...]]:
    """The addresses of names, in a thread: a name server that is silent takes half a minute for each.

    Each is asked for once: of many addresses a server may give others each time, and there is one file of hosts within.
    """
    deadline = time.monotonic() + within_s
    found: dict[str, tuple[str, ...]] = {}
    trouble: list[str] = []

    def ask() -> None:
        for name in names:
            if time.monotonic() > deadline:
                return
            try:
                rows = socket.getaddrinfo(name, None, type=socket.SOCK_STREAM)
            except (OSError, UnicodeError) as error:
                trouble.append(f"{name} has no address: {error}")
                return
            # fe80::1%eth0 is of an interface of this machine, which means nothing within.
            addresses = dict.fromkeys(str(row[4][0]) for row in rows if "%" not in str(row[4][0]))
            if not addresses:
                trouble.append(f"{name} has no address but of this machine's own links")
                return
            found[name] = tuple(addresses)

    thread = threading.Thread(target=ask, name="egress-names", daemon=True)
    thread.start()
    thread.join(within_s)
    late = thread.is_alive() or time.monotonic() > deadline
    if trouble or late:
        raise RuntimeFailure(f"needs.egress: {trouble[0] if trouble else 'the name server does not answer in time'}")
    return found
