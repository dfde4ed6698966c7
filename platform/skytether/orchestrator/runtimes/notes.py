"""Small files that orchestrators and services leave for one another at a process site."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

_MOST_BYTES = 64 << 10
"""Of a note that are read; they have some hundred."""


def read_json(path: Path) -> dict[str, Any]:
    """Empty if it is not there, or not (yet) such a document."""
    try:
        # The service may have put a link or a pipe there: neither is followed, and neither holds up whoever reads.
        file = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
        try:  # not by `open`, which leaves a folder's descriptor open
            document = json.loads(os.read(file, _MOST_BYTES))
        finally:
            os.close(file)
    except (OSError, ValueError, RecursionError):
        return {}
    return document if isinstance(document, dict) else {}


def noted_port(path: Path) -> int | None:
    """The port that a document names; None if it names none: services write what they like into their folders."""
    port = read_json(path).get("port")
    return port if type(port) is int and 0 < port < 65536 else None


def write_private(path: Path, content: str) -> None:
    """Mode 0600, complete or not at all; several orchestrators may write it at once."""
    draft = path.with_name(f"{path.name}.{os.getpid()}.new")
    with open(os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "w") as file:
        file.write(content)
    draft.replace(path)
