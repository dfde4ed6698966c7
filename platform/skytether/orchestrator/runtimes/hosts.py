"""Addresses in the options of sites."""

from __future__ import annotations

import ipaddress
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


def check_advertised(host: str) -> None:
    """Raise ValueError for an address that nobody can connect to."""
    if host in WILDCARDS:
        raise ValueError("advertise_host is needed: no robot can connect to a wildcard address")
