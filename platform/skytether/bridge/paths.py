"""A socket and a path of the session for each network that is there. In the bridge's thread; not thread-safe."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from .datagrams import Address, DatagramSocket
from .driver import Driver
from .interfaces import LocalPath, Network

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class UsablePath:
    """A network to use.

    Attributes:
        path: As it was wanted.
        peer: Address of the service's end as seen from this network; None: the same as from everywhere.
    """

    path: LocalPath
    peer: Address | None


class PeerNames:
    """Addresses of the peers that networks have of their own. Not in the bridge's thread: a name server may not answer.

    Args:
        resolve: Finds the address of a peer; its last argument is whether it must not ask a name server.
    """

    def __init__(self, resolve: Callable[[str, int, bool], Address]) -> None:
        """Know none yet."""
        self._resolve = resolve
        self._known: dict[tuple[str, int], Address] = {}
        self._told: set[Network] = set()

    def known(self, found: Mapping[Network, LocalPath]) -> dict[Network, UsablePath]:
        """The networks that can be used at once; never waits."""
        return self._usable(found, asking=False)

    def ask(self, found: Mapping[Network, LocalPath]) -> dict[Network, UsablePath]:
        """The networks that can be used; one whose peer has no address is named once. May wait for a name server."""
        return self._usable(found, asking=True)

    def _usable(self, found: Mapping[Network, LocalPath], *, asking: bool) -> dict[Network, UsablePath]:
        usable = {}
        for network, path in found.items():
            if path.peer is None:
                usable[network] = UsablePath(path, None)
                continue
            if path.peer not in self._known:
                try:
                    self._known[path.peer] = self._resolve(*path.peer, not asking)
                except OSError as error:
                    if asking and network not in self._told:
                        self._told.add(network)
                        _log.warning("Network %s %s cannot be used: %s", network.interface, network.address, error)
                    continue
            usable[network] = UsablePath(path, self._known[path.peer])
        return usable


class LocalPaths:
    """Opens and closes paths as networks come and go.

    Path 0 is the bridge's first socket; it ends when the first network is there.

    Args:
        driver: Of the session.
    """

    def __init__(self, driver: Driver) -> None:
        """Open nothing yet."""
        self._driver = driver
        self._open: dict[Network, tuple[int, LocalPath]] = {}
        self._next = 1
        self._first = True

    def use(self, found: Mapping[Network, UsablePath]) -> None:
        """Have a path for each of these, and none else."""
        for network in [n for n in self._open if n not in found]:
            path, _ = self._open.pop(network)
            _log.info("Network %s %s is gone", network.interface, network.address)
            self._driver.close_path(path)
        for network, wanted in found.items():
            if network not in self._open:
                self._add(network, wanted)
        if self._open and self._first:
            self._first = False
            self._driver.close_path(0)

    def set_cost(self, local: str, cost: int) -> None:
        """Prefer the networks that were named so less or more."""
        for network, (path, wanted) in self._open.items():
            if local in (wanted.local, network.address, network.interface):
                self._driver.set_cost(path, cost)

    def _add(self, network: Network, usable: UsablePath) -> None:
        wanted = usable.path
        try:
            sock = DatagramSocket((network.address, 0), device=network.interface)
        except OSError as error:  # gone again already
            _log.warning("Network %s %s cannot be used: %s", network.interface, network.address, error)
            return
        path, self._next = self._next, self._next % 255 + 1
        try:
            self._driver.open_path(path, sock, wanted.cost, usable.peer)
        except ValueError as error:  # the event loop takes no more descriptors
            _log.warning("Network %s %s cannot be used: %s", network.interface, network.address, error)
            sock.close()
            return
        self._open[network] = path, wanted
