"""A socket and a path of the session for each network that is there. In the bridge's thread; not thread-safe."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping

from .datagrams import Address, DatagramSocket
from .driver import Driver
from .interfaces import LocalPath, Network

_log = logging.getLogger(__name__)


class LocalPaths:
    """Opens and closes paths as networks come and go.

    Path 0 is the bridge's first socket; it ends when the first network is there.

    Args:
        driver: Of the session.
        resolve: Finds the address of a peer.
    """

    def __init__(self, driver: Driver, resolve: Callable[[str, int], Address]) -> None:
        """Open nothing yet."""
        self._driver = driver
        self._resolve = resolve
        self._open: dict[Network, tuple[int, LocalPath]] = {}
        self._next = 1
        self._first = True

    def use(self, found: Mapping[Network, LocalPath]) -> None:
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

    def _add(self, network: Network, wanted: LocalPath) -> None:
        try:
            peer = None if wanted.peer is None else self._resolve(*wanted.peer)
            sock = DatagramSocket((network.address, 0), device=network.interface)
        except OSError as error:  # gone again already, or a name service that cannot be reached
            _log.warning("Network %s %s cannot be used: %s", network.interface, network.address, error)
            return
        path, self._next = self._next, self._next % 255 + 1
        try:
            self._driver.open_path(path, sock, wanted.cost, peer)
        except ValueError as error:  # the event loop takes no more descriptors
            _log.warning("Network %s %s cannot be used: %s", network.interface, network.address, error)
            sock.close()
            return
        self._open[network] = path, wanted
