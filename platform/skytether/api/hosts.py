"""As whom an HTTP server lets itself be asked: against DNS rebinding.

A web page may give its own name the address of a server that is reachable from the browser only, and then read what
that answers. The browser names the page's host in each request, so a server that answers to its own names, and to
addresses, which no page can make its name, answers no such page.
"""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Iterable

_HOST = re.compile(r"(?:\[([0-9A-Fa-f:.]+)\]|([A-Za-z0-9_.-]{1,253}))(?::[0-9]{1,5})?")
ANY = "*"


def is_own(header: str, names: Iterable[str] = ()) -> bool:
    """Whether a request with this ``Host`` is for us: by an address, ``localhost``, or one of ``names``.

    Args:
        header: As it was sent.
        names: Of ours; ``*.example.org`` stands for all below, ``*`` for whatever.
    """
    found = _HOST.fullmatch(header)
    if found is None:
        return False
    host = (found[1] or found[2]).lower().removesuffix(".")
    return host == "localhost" or is_ip(host) or any(_fits(host, name.lower().removesuffix(".")) for name in names)


def is_ip(host: str) -> bool:
    """Whether this is an address, and no name."""
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


def is_name(text: str) -> bool:
    """Whether it can be one of ``is_own``'s names."""
    return text == ANY or re.fullmatch(r"(\*\.)?[A-Za-z0-9_-]+(\.[A-Za-z0-9_-]+)*", text) is not None


def _fits(host: str, name: str) -> bool:
    return name in (ANY, host) or (name.startswith("*.") and host.endswith(name[1:]))
