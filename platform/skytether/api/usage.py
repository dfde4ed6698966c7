"""What a run uses of its machine, as a service says it of its own container beside its reports.

    {"reports": [...], "usage": {"cpu_s": 1.25, "memory_bytes": 52428800, "received_bytes": 1000, "sent_bytes": 2000}}

Each of the figures may lack. No service is trusted: whoever reads them bounds them by what its container may have.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

_MOST = 2.0**62


@dataclass(frozen=True, slots=True)
class Usage:
    """Of one run, so far or now; None: not known."""

    cpu_s: float | None = None
    """Processor time so far."""
    memory_bytes: int | None = None
    """Now, without what the kernel could drop at any time."""
    received_bytes: int | None = None
    """By the network, so far."""
    sent_bytes: int | None = None


NO_USAGE = Usage()


def write_usage(usage: Usage) -> dict[str, float]:
    """As JSON has it."""
    return {key: value for key, value in asdict(usage).items() if value is not None}


def pull_usage(document: object) -> Usage:
    """Out of a document that anybody may have written; nothing of it that is no plain number."""
    told = document.get("usage") if isinstance(document, dict) else None
    if not isinstance(told, dict):
        return NO_USAGE
    found = {key: _number(told.get(key)) for key in ("cpu_s", "memory_bytes", "received_bytes", "sent_bytes")}
    cpu_s = found.pop("cpu_s")
    return Usage(cpu_s, **{key: None if value is None else int(value) for key, value in found.items()})


def _number(value: object) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return value if 0 <= value <= _MOST and math.isfinite(value) else None
