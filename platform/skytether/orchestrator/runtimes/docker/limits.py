"""What a container may take, as an engine is told when it is made or changed, and as it says it: pure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from skytether.api.manifest import ServiceSpec

from ..containers import most_cores, most_memory_mb

_LEAST_CORES = 0.01
"""The kernel gives no less."""


class ContainerLimits(NamedTuple):
    """Of one container."""

    memory: int = 0
    """Bytes."""
    nano_cpus: int = 0
    """Billionths of cores."""
    cpu_shares: int = 0
    """Of what cores others want too."""

    def document(self) -> dict[str, int]:
        """As the engine takes it. Nothing beyond its memory: a service that swaps is of no use to a robot."""
        swap = {"Memory": self.memory, "MemorySwap": self.memory}
        return {**swap, "NanoCpus": self.nano_cpus, "CpuShares": self.cpu_shares}


NO_LIMITS = ContainerLimits()


def limits_of(spec: ServiceSpec, cores: float) -> ContainerLimits:
    """Of a service's container; ``cores``: the engine's machine's, which refuses more."""
    most = max(_LEAST_CORES, min(most_cores(spec), cores))
    return ContainerLimits(most_memory_mb(spec) << 20, int(most * 1e9), max(2, int(spec.needs.cpu * 1024)))


def pull_limits(host_config: Mapping[str, Any]) -> ContainerLimits:
    """Out of the engine's description."""
    memory, nano, shares = (int(host_config.get(key) or 0) for key in ("Memory", "NanoCpus", "CpuShares"))
    return ContainerLimits(memory, nano, shares)
