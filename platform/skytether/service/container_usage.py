"""What the service's own container uses, as the kernel tells it: control groups of both versions, see cgroups(7)."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from skytether.api.usage import Usage

_GROUP = Path("/sys/fs/cgroup")
"""In a container, its own group."""
_NETWORK = Path("/proc/net/dev")
_SENT = 8
"""Column of the bytes that were sent."""


def container_usage(group: Path = _GROUP, network: Path = _NETWORK) -> Usage:
    """All that can be read of it.

    Args:
        group: Where the container's control group is seen.
        network: What the kernel counts of its network interfaces.
    """
    received, sent = _network(network)
    if (group / "cgroup.controllers").exists():
        usec = _named(group / "cpu.stat", "usage_usec")
        cpu_s = None if usec is None else usec / 1e6
        memory = _less(_number(group / "memory.current"), _named(group / "memory.stat", "inactive_file"))
    else:
        nsec = _number(group / "cpuacct/cpuacct.usage")
        cpu_s = None if nsec is None else nsec / 1e9
        idle = _named(group / "memory/memory.stat", "total_inactive_file")
        memory = _less(_number(group / "memory/memory.usage_in_bytes"), idle)
    return Usage(cpu_s, memory, received, sent)


def _less(total: int | None, idle: int | None) -> int | None:
    return None if total is None else max(0, total - (idle or 0))


def _number(path: Path) -> int | None:
    with suppress(OSError, ValueError):
        return int(path.read_text())
    return None


def _named(path: Path, name: str) -> int | None:
    """The number behind a name that begins a line."""
    with suppress(OSError, ValueError, IndexError):
        return next(
            (int(line.split()[1]) for line in path.read_text().splitlines() if line.startswith(f"{name} ")), None
        )
    return None


def _network(path: Path) -> tuple[int | None, int | None]:
    """Bytes received and sent by all interfaces but the loopback."""
    with suppress(OSError, ValueError, IndexError):
        lines = (line.partition(":") for line in path.read_text().splitlines()[2:])
        rows = [[int(field) for field in fields.split()] for name, _, fields in lines if name.strip() != "lo"]
        return sum(row[0] for row in rows), sum(row[_SENT] for row in rows)
    return None, None
