"""What is seen of an orchestrator from outside: its answers' times, its processes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil

from skytether.api.grant import GRANT_VARIABLE


@dataclass(frozen=True, slots=True)
class Spread:
    """Times in milliseconds."""

    n: int
    p50_ms: float
    p99_ms: float
    max_ms: float

    @classmethod
    def of(cls, seconds: list[float]) -> Spread:
        """Of at least one time."""
        p50, p99, most = np.percentile(seconds, [50, 99, 100], method="inverted_cdf") * 1e3
        return cls(len(seconds), round(float(p50), 2), round(float(p99), 2), round(float(most), 2))


def cpu_seconds(pid: int) -> float:
    """Processor time of a process since its start."""
    return sum(psutil.Process(pid).cpu_times()[:2])


def instance_of(process: psutil.Process) -> str | None:
    """Whose process this is, by its grant's path; None: no instance's."""
    try:
        grant = process.environ().get(GRANT_VARIABLE)
    except psutil.Error:
        return None
    parts = Path(grant or "").parts
    return parts[parts.index("instances") + 1] if "instances" in parts[:-1] else None
