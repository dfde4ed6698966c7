"""Which of this machine's networks a robot's end uses: found, and watched for what comes and goes (rule 8).

Asks the system once a second, which works on every one and costs a millisecond. Knows nothing of sessions.
"""

from __future__ import annotations

import ipaddress
import socket
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import psutil

POLL_INTERVAL = 1.0
"""Seconds until a change is noticed. A path that is cut is left sooner, by its missing answers."""
_END_S = 0.5
"""For a watch that is to end."""
NOT_NETWORKS = ("lo", "docker", "br-", "veth", "virbr", "cni", "flannel", "cali", "lxc", "podman")
"""Beginnings of the names of interfaces that lead nowhere but into this machine."""
COSTS = (("wl", 10), ("ww", 20), ("ppp", 20), ("usb", 20))
"""By the beginning of the name: wireless and mobile networks are used after the wired."""


@dataclass(frozen=True, slots=True)
class LocalPath:
    """One network that the robot's end may use.

    Attributes:
        local: The interface's name (``wlan0``) or one of this machine's addresses.
        cost: 0 to 255: of networks that work as well as each other the cheapest is used.
        peer: Where the service's end is as seen from this network, if not where the bridge's ``peer`` says.
    """

    local: str
    cost: int = 0
    peer: tuple[str, int] | None = None

    def __post_init__(self) -> None:
        """Refuse what cannot be.

        Raises:
            ValueError: The text names the field and its range.
        """
        if not self.local:
            raise ValueError("paths: local must be an interface's name or a local address")
        if not 0 <= self.cost <= 255:
            raise ValueError(f"paths: cost of {self.local} must be 0 to 255, not {self.cost}")


Wanted = Sequence[LocalPath] | Literal["auto"]


@dataclass(frozen=True, slots=True)
class Network:
    """An interface's address that is there now."""

    interface: str
    address: str


Addresses = Mapping[str, Iterable[str]]
"""IP addresses by interface."""


def addresses(family: int = socket.AF_INET) -> dict[str, list[str]]:
    """What this machine has now: interfaces that are up, with their addresses of that family."""
    up = psutil.net_if_stats()
    return {
        name: [a.address for a in rows if a.family == family]
        for name, rows in psutil.net_if_addrs().items()
        if name in up and up[name].isup
    }


def select(wanted: Wanted, present: Addresses) -> dict[Network, LocalPath]:
    """Which networks to use, of those that are there.

    Args:
        wanted: Listed by name or address, or ``auto``: all that lead out of this machine.
        present: Addresses by interface.
    """
    chosen: dict[Network, LocalPath] = {}
    if wanted == "auto":
        for name, found in present.items():
            if not name.startswith(NOT_NETWORKS):
                cost = next((c for beginning, c in COSTS if name.startswith(beginning)), 0)
                chosen.update(
                    (Network(name, a), LocalPath(name, cost))
                    for a in found
                    if not ipaddress.ip_address(a).is_link_local
                )
        return chosen
    for path in wanted:
        for name, found in present.items():
            for address in found:
                if path.local in (name, address) or (name.startswith("lo") and _loops(path.local)):
                    chosen[Network(name, path.local if _loops(path.local) else address)] = path
                    break
    return chosen


def _loops(address: str) -> bool:
    """Whether an address is one of the many of the loopback interface, which lists only one."""
    try:
        return ipaddress.ip_address(address).is_loopback
    except ValueError:
        return False


class Watcher:
    """Tells what came and went, from a thread of its own, until closed.

    Args:
        list_networks: Asks the system.
        changed: Called with all networks to use, whenever they are others than before; gives those that are now used.
            It may wait for a name server.
        known: Those that are used already.
    """

    def __init__(
        self,
        list_networks: Callable[[], dict[Network, LocalPath]],
        changed: Callable[[dict[Network, LocalPath]], Mapping[Network, object]],
        known: Iterable[Network],
    ) -> None:
        """Start."""
        self._list_networks = list_networks
        self._changed = changed
        self._known = set(known)
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="networks", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread; one that waits for a name server is left behind."""
        self._closing.set()
        self._thread.join(_END_S)

    def _run(self) -> None:
        while not self._closing.wait(POLL_INTERVAL):
            found = self._list_networks()
            if found.keys() != self._known:
                self._known = set(self._changed(found))
