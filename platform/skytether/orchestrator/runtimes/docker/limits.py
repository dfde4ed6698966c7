"""What a container may take, as an engine is told when it is made or changed, and as it says it: pure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from skytether.api.manifest import ServiceSpec

from ..containers import most_cores, most_memory_mb

_LEAST_CORES = 0.01
"""The kernel gives no less."""
_SHARES_PER_CORE = 10 * 1024
"""Of the processors, where others want them too; other programs of the machine, the engine and what it starts, have
1024. A robot waits for what a service says: one that needs a core goes before them. With much more, one that may use
all cores would keep an engine from ending it."""
_LEAST_SHARES, _MOST_SHARES = 2, 1 << 18
"""That a kernel takes."""


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
    shares = max(_LEAST_SHARES, min(int(spec.needs.cpu * _SHARES_PER_CORE), _MOST_SHARES))
    return ContainerLimits(most_memory_mb(spec) << 20, int(most * 1e9), shares)


def parent_of(info: Mapping[str, Any]) -> dict[str, str]:
    """Where among the machine's groups of processes a service's container belongs, by what the engine says of itself.

    With systemd, containers stand beside the engine. An engine that makes its groups itself puts all containers into
    one, which has no more of the processors than any one thread outside of it, whatever they have within.
    """
    rootless = info.get("Rootless") or "rootless" in security_of(info)
    return {"CgroupParent": "/"} if info.get("CgroupDriver") == "cgroupfs" and not rootless else {}


def security_of(info: Mapping[str, Any]) -> set[str]:
    """What an engine holds its containers by, and ``rootless`` of one that is not root."""
    return {option.partition(",")[0].removeprefix("name=") for option in info.get("SecurityOptions") or ()}


def pull_limits(host_config: Mapping[str, Any]) -> ContainerLimits:
    """Out of the engine's description."""
    memory, nano, shares = (int(host_config.get(key) or 0) for key in ("Memory", "NanoCpus", "CpuShares"))
    return ContainerLimits(memory, nano, shares)
