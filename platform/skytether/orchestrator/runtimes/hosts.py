"""Addresses in the options of sites."""

from __future__ import annotations

import hashlib
import ipaddress
from collections.abc import Sequence
from typing import Annotated

from pydantic import AfterValidator, Field

WILDCARDS = ("0.0.0.0", "::")  # noqa: S104
"""All addresses of a machine: to listen on, not to connect to."""


def _ip_address(text: str) -> str:
    """A container engine takes a name for a wildcard, without a word."""
    try:
        return str(ipaddress.ip_address(text))
    except ValueError:
        raise ValueError(f"must be an address such as 192.0.2.7, not '{text}'") from None


BindHost = Annotated[str, AfterValidator(_ip_address)]
"""A number, no name."""
AdvertisedHost = Annotated[str, Field(min_length=1, max_length=253)]
"""A number or a name."""


def rendezvous(key: str, addresses: Sequence[str]) -> str:
    """The one of several addresses that a key chooses, whoever asks and in whatever order they are listed.

    Where one is added or taken out, only the keys that choose it, or chose it, have another one than before (Thaler and
    Ravishankar, 1998).
    """
    return max(addresses, key=lambda one: hashlib.blake2b(f"{one} {key}".encode(), digest_size=8).digest())


def parse_address(text: str) -> tuple[str, int]:
    """Read ``HOST:PORT`` or ``[IPV6]:PORT``, to connect to.

    Raises:
        ValueError: It is neither, or a wildcard.
    """
    host, colon, port = text.rpartition(":")
    if host.startswith("[") and host.endswith("]"):
        host = host[1:-1]
    elif ":" in host:
        host = ""
    if not colon or not host or not (port.isascii() and port.isdecimal()) or not 0 < int(port) < 1 << 16:
        raise ValueError(f"'{text}' must be HOST:PORT with a port of 1 to 65535, [ADDRESS]:PORT for IPv6")
    if host in WILDCARDS:
        raise ValueError(f"no robot can connect to the wildcard address {host}")
    return host, int(port)


def check_advertised(host: str) -> None:
    """Raise ValueError for an address that nobody can connect to."""
    if host in WILDCARDS:
        raise ValueError("advertise_host is needed: no robot can connect to a wildcard address")
