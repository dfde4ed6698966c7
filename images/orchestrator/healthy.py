"""Whether the orchestrator in this container answers, at the address that it wrote when it began to listen."""

from __future__ import annotations

import ssl
import sys
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import urlopen

ADDRESS = Path("/var/lib/skytether/address")
_LOOPBACK = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}  # noqa: S104 (what is listened on)
_PATIENCE = 2.0
"""Seconds."""


def url(address: str) -> str:
    """Where to ask: on loopback, where it listens on all addresses."""
    parts = urlsplit(address.strip())
    host = parts.hostname or ""
    return f"{parts.scheme}://{_LOOPBACK.get(host) or (f'[{host}]' if ':' in host else host)}:{parts.port}/healthz"


def main() -> int:
    """The command."""
    context = ssl.create_default_context()
    # The certificate is for others, by another name; nothing leaves this container, and nothing secret is sent.
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    try:
        urlopen(url(ADDRESS.read_text()), timeout=_PATIENCE, context=context).close()  # noqa: S310
    except (OSError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
