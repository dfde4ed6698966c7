"""How far plain HTTP may go: whoever is on the way reads tokens and keys of sessions in it, so not off this machine."""

from __future__ import annotations

import ipaddress
from urllib.parse import urlsplit

VARIABLE = "SKYTETHER_INSECURE_HTTP"
"""For commands; also that of the orchestrator's setting ``insecure_http``."""


def is_loopback(host: str) -> bool:
    """Whether what is sent there stays on this machine; names are not looked up."""
    try:
        return host.lower() == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def is_readable_on_the_way(url: str) -> bool:
    """Whether requests to this address leave the machine without TLS."""
    try:
        parts = urlsplit(url.strip())
        host = parts.hostname or ""
    except ValueError:
        return False  # no address: nothing is sent
    # To the wildcard addresses the kernel connects on loopback; an orchestrator that listens there writes them down.
    return parts.scheme == "http" and not is_loopback(host) and host not in ("0.0.0.0", "::")  # noqa: S104


def is_allowed(environment_value: str | None) -> bool:
    """What ``SKYTETHER_INSECURE_HTTP`` says."""
    return (environment_value or "").strip().lower() in ("1", "true", "yes", "on")
