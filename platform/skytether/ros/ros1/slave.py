"""XML-RPC of ROS 1: what master and other nodes ask of a node (wiki.ros.org/ROS/Slave_API)."""

from __future__ import annotations

import ipaddress
import os
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from socketserver import ThreadingMixIn
from typing import Any, Protocol, cast
from urllib.parse import urlsplit
from xmlrpc.server import SimpleXMLRPCRequestHandler, SimpleXMLRPCServer

MAX_REQUEST = 2**20
"""Bytes of a request: the longest is a list of publishers."""
FROM_MASTER = ("shutdown", "publisherUpdate")
"""What ends the node, or takes its topics to other publishers: only the machine of the master may, and this one."""
_RESOLVED_S = 10.0
"""So long a name's addresses are good: others may make us look it up."""
MOST_CONNECTIONS = 256
"""Connections at a time, each of which has a thread; half as many from one address, so that a stranger's do not keep
the master out. All nodes of a machine may ask at once, when a topic that they want comes; each is answered and closed.
"""
_IDLE_S = 30.0
"""A connection that says nothing for so long is closed."""


class NodeApi(Protocol):
    """What a node answers with."""

    name: str
    master_uri: str

    def publishers_changed(self, topic: str, uris: list[str]) -> None:
        """The master says who publishes a topic now."""
        ...

    def offered(self, topic: str) -> tuple[str, int] | None:
        """Where a topic of this node can be had; None if it has no such topic."""
        ...

    def publications(self) -> list[list[str]]:
        """Topics and types that it offers."""
        ...

    def subscriptions(self) -> list[list[str]]:
        """Topics and types that it takes."""
        ...

    def connections(self) -> list[list[Any]]:
        """As getBusInfo tells them."""
        ...

    def asked_to_end(self, reason: str) -> None:
        """Somebody wants the node to end."""
        ...


class MasterHost:
    """Whether somebody is on the master's machine. Safe from any thread."""

    def __init__(self, master_uri: str, clock: Callable[[], float] = time.monotonic) -> None:
        self._host = urlsplit(master_uri).hostname or ""
        self._clock = clock
        self._addresses: frozenset[str] = frozenset()
        self._until = 0.0

    def __call__(self, address: str) -> bool:
        if ipaddress.ip_address(address.partition("%")[0]).is_loopback:
            return True
        if self._clock() >= self._until:
            self._until = self._clock() + _RESOLVED_S
            with suppress(OSError):  # the name server is away: those of before
                self._addresses = frozenset(str(found[4][0]) for found in socket.getaddrinfo(self._host, None))
        return address in self._addresses


class _Handler(SimpleXMLRPCRequestHandler):
    rpc_paths = ()  # nodes ask at / or /RPC2
    timeout = _IDLE_S
    disable_nagle_algorithm = True

    def do_POST(self) -> None:  # noqa: N802 (named by the library)
        length = self.headers.get("content-length", "")
        if not length.isdigit() or int(length) > MAX_REQUEST or "content-encoding" in self.headers:
            self.send_error(413)
            self.close_connection = True
            return
        super().do_POST()

    def _dispatch(self, method: str, params: tuple[Any, ...]) -> Any:
        asker, here, server = self.client_address[0], self.connection.getsockname()[0], cast("_Server", self.server)
        if method in FROM_MASTER and asker != here and not server.trusts(asker):
            return -1, f"{method} is taken from the machine of the master only", 0
        return server._dispatch(method, params)  # noqa: SLF001 (the library's way to put something before it)

    def log_request(self, code: int | str = "-", size: int | str = "-") -> None:
        """Nobody reads it."""

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002
        """Nobody reads it."""


class _Server(ThreadingMixIn, SimpleXMLRPCServer):
    daemon_threads = True
    block_on_close = False
    request_queue_size = MOST_CONNECTIONS
    """Who finds no room in it comes again after a second, by its kernel's timer."""
    trusts: Callable[[str], bool]
    most = MOST_CONNECTIONS

    def __init__(self, *arguments: Any, **more: Any) -> None:
        super().__init__(*arguments, **more)
        self._open: Counter[str] = Counter()
        self._lock = threading.Lock()

    def process_request(self, request: Any, client_address: Any) -> None:
        """In a thread of its own; who comes on top of those that there may be is closed."""
        asker = client_address[0]
        with self._lock:
            full = self._open.total() >= self.most or self._open[asker] >= self.most // 2
            if not full:
                self._open[asker] += 1
        if full:
            self.shutdown_request(request)
            return
        try:
            super().process_request(request, client_address)
        except RuntimeError:  # no more threads are to be had
            self._closed(asker)
            raise

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """To the end of a connection."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._closed(client_address[0])

    def _closed(self, asker: str) -> None:
        with self._lock:
            self._open[asker] -= 1
            if self._open[asker] <= 0:
                del self._open[asker]

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A connection that broke off, or a request that is none: the asker's matter."""


class SlaveServer:
    """Answers for a node until it is closed.

    Attributes:
        port: Where it listens.
    """

    def __init__(
        self, api: NodeApi, bind: str, trusts: Callable[[str], bool] | None = None, most: int = MOST_CONNECTIONS
    ) -> None:
        """Listen.

        Args:
            api: Answers.
            bind: Address to listen on.
            trusts: Whether an address is the master's; found by its name unless given.
            most: Connections at a time.

        Raises:
            OSError: The address is not this machine's.
        """
        self._server = _Server((bind, 0), _Handler, allow_none=True, logRequests=False)
        self._server.trusts = trusts or MasterHost(api.master_uri)
        self._server.most = most
        self.port: int = self._server.server_address[1]
        for name, function in _methods(api).items():
            self._server.register_function(function, name)
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(0.2,), name=f"ros1-api-{self.port}", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Listen no more."""
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()


def _methods(api: NodeApi) -> dict[str, Callable[..., Any]]:
    def request_topic(_caller: str, topic: str, protocols: list[list[Any]]) -> Any:
        where = api.offered(topic)
        if where is None:
            return -1, f"{api.name} does not publish {topic}", []
        if not any(protocol and protocol[0] == "TCPROS" for protocol in protocols):
            return 0, f"{api.name} speaks TCPROS only", []
        return 1, "ready", ["TCPROS", *where]

    def publisher_update(_caller: str, topic: str, uris: list[str]) -> Any:
        api.publishers_changed(topic, [str(uri) for uri in uris])
        return 1, "", 0

    def shutdown(_caller: str, reason: str = "") -> Any:
        api.asked_to_end(str(reason))
        return 1, "shutdown", 0

    return {
        "requestTopic": request_topic,
        "publisherUpdate": publisher_update,
        "shutdown": shutdown,
        "paramUpdate": lambda *_: (1, "", 0),
        "getPid": lambda *_: (1, "", os.getpid()),
        "getMasterUri": lambda *_: (1, "", api.master_uri),
        "getName": lambda *_: (1, "", api.name),
        "getPublications": lambda *_: (1, "", api.publications()),
        "getSubscriptions": lambda *_: (1, "", api.subscriptions()),
        "getBusInfo": lambda *_: (1, "", api.connections()),
        "getBusStats": lambda *_: (1, "", [[], [], []]),
    }
