"""Who may hold a connection, and for how long: the part of the server that stands before every request.

Uvicorn reads requests well, but waits for them without end: for a head, for a body, for somebody to take an answer, and
of as many as come. Other servers that are as well kept wait for bodies no less (Granian), or cost several times as much
a request (Hypercorn). So Uvicorn stays, and this is the guard around its protocol: it takes connections itself, before
TLS costs anything, and ends those that are late. All of it runs in the server's loop.
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import ipaddress
import logging
import math
import socket
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterable
from typing import Any

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from ..config.settings import ServerLimits
from ..domain.overload import Overload
from .certificate import LiveCertificate

log = logging.getLogger(__name__)

CONNECTION = "skytether.connection"
"""Key of the connection's connection in an ASGI scope."""
_SWEEP = 0.5
"""Seconds between two looks for connections that are late."""
_AT_ONCE = 8
"""Connections that are taken in one go, so that requests under way have their turn in between: some milliseconds."""
_WITHOUT_FILES = 0.1
"""Seconds until the next attempt, when the system has no file for another connection."""
_TAKEN_S = 30.0
"""Seconds in which somebody who was answered takes something of it; a stream is read as it comes."""
_CROWD = 256
"""After so many connections have gone, what they used is given back to the system."""
_MOST_AROUND = 1 << 18
"""Bytes of a request that are not its body: line, headers, what frames chunks."""
_MOST_HEAD = 1 << 15
"""Bytes of its line and headers. Strangers hold 1,024 of them."""
_MOST_FIELDS = 100
"""Headers of a request: each takes more memory than it has bytes, 5 MB for 256 KiB of short ones."""
_PIECE = 1 << 14
"""Bytes that the parser gets at once: what it has of a header that goes on is not told before the next ones."""


class Connection:
    """One connection."""

    def __init__(self, address: str, deadline: float, known: Callable[[Connection, str], None]) -> None:
        """``deadline`` by the loop's clock: of what it owes us now; ``known`` is called when it shows a token."""
        self._known = known
        self.address = address
        self.deadline = deadline
        self.takes_by = math.inf
        """Until when it must take some of what it is sent."""
        self.owner = ""
        """Whose token it has shown; empty: nobody's yet."""
        self.busy = False
        """A request of it is under way."""
        self.protocol: GuardedProtocol | None = None
        self.socket: socket.socket | None = None
        """Until there is a protocol."""

    def know(self, owner: str) -> None:
        """It has shown a good token of this owner."""
        self._known(self, owner)

    def end(self) -> None:
        """Close it, whatever it waits for."""
        if self.protocol is not None:
            with contextlib.suppress(AttributeError):  # uvicorn has closed it twice: see `skytether.api.splice.close`
                self.protocol.transport.abort()
        elif self.socket is not None:
            with contextlib.suppress(OSError):  # it is gone already
                # The loop has it while TLS is agreed upon: shut down, it ends there as if the other side had left.
                self.socket.shutdown(socket.SHUT_RDWR)


class ConnectionTable:
    """Who is here. Decides who else may come in, and who gives way: of all, and of each address and owner. Pure."""

    def __init__(self, limits: ServerLimits, most: int) -> None:
        """``most``: connections in all."""
        self._limits = limits
        self._most = most
        self.connections: set[Connection] = set()
        self._at: Counter[str] = Counter()
        self._strangers: dict[str, OrderedDict[Connection, None]] = {}
        """Without a token so far, by address, the oldest first."""
        self._strange = 0
        """How many these are."""
        self._of: dict[str, OrderedDict[Connection, None]] = {}
        """By owner, the one that was quiet for the longest first."""

    def room(self, address: str, *, free: bool = False) -> tuple[bool, Connection | None]:
        """Whether another one may come in, and who has to give way for it; ``free``: an address without a bound."""
        if len(self.connections) >= self._most or self._strange >= self._limits.strangers:
            gives_way = self.stranger()
            return gives_way is not None, gives_way
        if not free and self._at[address] >= self._limits.connections_per_address:
            gives_way = next(iter(self._strangers.get(address, ())), None)
            return gives_way is not None, gives_way
        return True, None

    def stranger(self) -> Connection | None:
        """Of the address with most connections without a token, the one that has been here for the longest."""
        of_address = max(self._strangers.values(), key=len, default=None)
        return next(iter(of_address)) if of_address else None

    def is_alone(self, connection: Connection) -> bool:
        """Whether its address has no other connection."""
        return self._at[connection.address] == 1

    def come(self, connection: Connection) -> None:
        """It is here now."""
        self.connections.add(connection)
        self._at[connection.address] += 1
        self._strangers.setdefault(connection.address, OrderedDict())[connection] = None
        self._strange += 1

    def know(self, connection: Connection, owner: str) -> Connection | None:
        """It has shown a good token; perhaps another one of the same owner gives way."""
        if connection not in self.connections:
            return None
        if connection.owner != owner:
            self._forget_stranger(connection)
            self._forget_owner(connection)
            connection.owner = owner
        mine = self._of.setdefault(owner, OrderedDict())
        mine[connection] = None
        mine.move_to_end(connection)
        if owner.startswith("robot:") and len(mine) > self._limits.connections_per_robot:
            return next((one for one in mine if not one.busy), next(iter(mine)))
        return None

    def leave(self, connection: Connection) -> None:
        """It is here no more."""
        if connection not in self.connections:
            return
        self.connections.discard(connection)
        self._forget_stranger(connection)
        self._forget_owner(connection)
        self._at[connection.address] -= 1
        if not self._at[connection.address]:
            del self._at[connection.address]

    def _forget_stranger(self, connection: Connection) -> None:
        of_address = self._strangers.get(connection.address)
        if of_address is not None and connection in of_address:
            del of_address[connection]
            self._strange -= 1
            if not of_address:
                del self._strangers[connection.address]

    def _forget_owner(self, connection: Connection) -> None:
        mine = self._of.get(connection.owner)
        if mine is not None:
            mine.pop(connection, None)
            if not mine:
                del self._of[connection.owner]

    def late(self, now: float) -> list[Connection]:
        """Those who owe us something for too long."""
        return [
            connection for connection in self.connections if now >= connection.deadline or now >= connection.takes_by
        ]


class _AheadError(Exception):
    """A request came before the answer to the one before."""


class _HeadError(Exception):
    """A request's head is too large; the parser goes no further."""


class GuardedProtocol(HttpToolsProtocol):
    """Uvicorn's, with a deadline for each part of a request, a bound on what is not body, and one request at a time."""

    connection: Connection
    table: ConnectionTable
    limits: ServerLimits
    _around = 0
    _head = 0
    """Bytes of the line and of headers that are complete."""
    _reads_head = False
    _too_large = False
    _reads_body = False
    _idle = False
    _ahead = False
    """It has asked again before it was answered."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self.connection.protocol = self

    def connection_lost(self, exc: Exception | None) -> None:
        self.table.leave(self.connection)
        super().connection_lost(exc)
        # They hold this, and it holds them: hundreds would wait for the collector, which holds up everybody.
        self.connection.protocol = self.cycle = None  # type: ignore[assignment]

    def data_received(self, data: bytes) -> None:
        for begin in range(0, len(data), _PIECE):
            if not self.transport.is_closing():
                self._feed(data[begin : begin + _PIECE])

    def _feed(self, data: bytes) -> None:
        self._around += len(data)
        if self._ahead:  # what comes until it is answered is thrown away, and who sends on and on is cut off
            if self._around > _MOST_AROUND:
                self.transport.abort()
            return
        super().data_received(data)
        most = _MOST_HEAD if self._reads_head else _MOST_AROUND
        if self._around > most and not self.transport.is_closing():
            self._too_large = True
            self.send_400_response("")

    def send_400_response(self, msg: str) -> None:
        if not self._ahead:  # there is an answer under way
            super().send_400_response("The request's headers are too large." if self._too_large else msg)

    def on_message_begin(self) -> None:
        if self.cycle is not None and not self.cycle.response_complete:
            # Thousands fit into one read, and Uvicorn keeps them all, reads on after each answer, and writes the others
            # when nobody is there any more. So the one that is under way is answered, and the connection ends (RFC
            # 9112, 9.3.2); the error keeps the parser from the others.
            self._ahead, self.cycle.keep_alive = True, False
            raise _AheadError
        self._around = self._head = 0
        self._reads_head = True
        super().on_message_begin()
        self.scope[CONNECTION] = self.connection  # type: ignore[literal-required]
        if self._idle:  # the first head is due from the moment when the connection was taken
            self._idle = False
            self._owes(self.limits.head_s)

    def on_url(self, url: bytes) -> None:
        self._keep(len(url))
        super().on_url(url)

    def on_header(self, name: bytes, value: bytes) -> None:
        if not self._reads_head:
            return  # after the body: nobody here asks for those
        self._keep(len(name) + len(value))
        if len(self.headers) >= _MOST_FIELDS:
            self._refuse_head()
        super().on_header(name, value)

    def _keep(self, size: int) -> None:
        self._head += size
        if self._head > _MOST_HEAD:
            self._refuse_head()

    def _refuse_head(self) -> None:
        self._too_large = True
        raise _HeadError

    def on_headers_complete(self) -> None:
        self._reads_head, self._reads_body = False, True
        self._owes(self.limits.body_s)
        super().on_headers_complete()
        self.connection.busy = True

    def on_body(self, body: bytes) -> None:
        self._around -= len(body)
        super().on_body(body)

    def on_message_complete(self) -> None:
        self._reads_body = False
        if self.connection.busy:
            self.connection.deadline = math.inf  # now it is our turn
        else:
            self._rest()
        super().on_message_complete()

    def on_response_complete(self) -> None:
        super().on_response_complete()
        # Another request of the connection may wait already; one that was refused may still be sending its body, which
        # is read and thrown away, for who writes does not read an answer before a connection is cut off.
        self.connection.busy = self.cycle is not None and not self.cycle.response_complete
        if not self.connection.busy and not self._reads_body:
            self._rest()

    def pause_writing(self) -> None:
        super().pause_writing()
        self.connection.takes_by = self._in(_TAKEN_S)

    def resume_writing(self) -> None:
        super().resume_writing()
        self.connection.takes_by = math.inf

    def _rest(self) -> None:
        self._idle = True
        self._owes(self.limits.idle_s)

    def _owes(self, seconds: float) -> None:
        self.connection.deadline = self._in(seconds)

    def _in(self, seconds: float) -> float:
        return self.loop.time() + seconds


class Acceptor:
    """Takes connections from a listener; to Uvicorn it is a server that can be closed."""

    def __init__(
        self,
        listener: socket.socket,
        make: Callable[[], Any],
        tls: LiveCertificate | None,
        limits: ServerLimits,
        most: int,
        proxies: Iterable[str],
        overload: Overload,
    ) -> None:
        """Begin to take connections, in the running loop.

        Args:
            listener: Listens, and does not block.
            make: Makes a protocol.
            tls: None: without.
            limits: How many, and how long.
            most: Connections in all, by what the system lets us have.
            proxies: Addresses and networks whose connections are many people's.
            overload: Told when somebody was refused for want of room.
        """
        self._listener = listener
        self._make = make
        self._tls = tls
        self._limits = limits
        self._proxies = tuple(ipaddress.ip_network(proxy, strict=False) for proxy in proxies)
        self._overload = overload
        self._loop = asyncio.get_running_loop()
        self._tasks: set[asyncio.Task[None]] = set()
        self._told_at = -math.inf
        self._most_here = 0
        """Since memory was given back."""
        self.table = ConnectionTable(limits, most)
        listener.setblocking(False)
        self._open = True
        self._loop.add_reader(listener.fileno(), self._accept)
        self._sweeping = self._loop.create_task(self._sweep())

    def close(self) -> None:
        """Take no more; those who are in stay."""
        if self._open:
            self._open = False
            self._loop.remove_reader(self._listener.fileno())

    async def wait_closed(self) -> None:
        """Until nothing of it runs any more."""
        self._sweeping.cancel()
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(self._sweeping, *self._tasks, return_exceptions=True)

    def _know(self, connection: Connection, owner: str) -> None:
        gives_way = self.table.know(connection, owner)
        if gives_way is not None:
            self._end(gives_way)

    def _accept(self) -> None:
        for _ in range(_AT_ONCE):
            try:
                taken, peer = self._listener.accept()
            except (BlockingIOError, ConnectionAbortedError):
                return
            except OSError as error:  # no file, or no memory, for another one
                self._without_files(error)
                return
            self._admit(taken, peer[0])

    def _admit(self, taken: socket.socket, host: str) -> None:
        address, proxy = place_of(host), self._is_proxy(host)
        has_room, gives_way = self.table.room(address, free=proxy)
        if gives_way is not None:
            if self.table.is_alone(gives_way):  # alone of its address: it may have been a robot about to renew
                self._overload.note()
            self._end(gives_way)
        if not has_room:
            taken.close()
            self._overload.note()
            self._warn("no room for a connection from %s: all that are open have shown a token", address)
            return
        connection = Connection(address, self._loop.time() + self._limits.head_s, self._know)
        self.table.come(connection)
        if proxy:
            self.table.know(connection, f"proxy {address}")
        task = self._loop.create_task(self._greet(taken, connection))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _greet(self, taken: socket.socket, connection: Connection) -> None:
        taken.setblocking(False)
        connection.socket = taken
        protocol: Any = None

        def make() -> Any:
            nonlocal protocol
            protocol = self._make()
            protocol.connection, protocol.table, protocol.limits = connection, self.table, self._limits
            return protocol

        agreed = {"ssl": self._tls.context, "ssl_handshake_timeout": self._limits.head_s} if self._tls else {}
        try:
            await self._loop.connect_accepted_socket(make, taken, **agreed)  # type: ignore[arg-type]
        except (OSError, asyncio.CancelledError) as error:  # it left, or what it speaks is no TLS
            forget_frames(error)
            self.table.leave(connection)
            taken.close()
            if protocol is not None:
                protocol.parser = None  # it holds the protocol, which holds it: thousands would wait for the collector
        finally:
            connection.socket = None

    def _end(self, connection: Connection) -> None:
        self.table.leave(connection)
        connection.end()

    def _without_files(self, error: OSError) -> None:
        """Robots that would come in now cannot: a stranger gives way, and the next attempt is a moment later."""
        self._overload.note()
        self._warn("a connection cannot be taken: %s", error.strerror)
        gives_way = self.table.stranger()
        if gives_way is not None:
            self._end(gives_way)
        self._loop.remove_reader(self._listener.fileno())
        self._loop.call_later(_WITHOUT_FILES, self._again)

    def _again(self) -> None:
        if self._open:
            self._loop.add_reader(self._listener.fileno(), self._accept)

    async def _sweep(self) -> None:
        while True:
            self._overload.beat()
            now = self._loop.time()
            for connection in self.table.late(now):
                self._end(connection)
            here = len(self.table.connections)
            self._most_here = max(self._most_here, here)
            if self._most_here - here >= _CROWD:
                self._most_here = here
                _give_back()
            await asyncio.sleep(_SWEEP)

    def _is_proxy(self, address: str) -> bool:
        try:
            return any(ipaddress.ip_address(address) in network for network in self._proxies)
        except ValueError:
            return False

    def _warn(self, text: str, what: object) -> None:
        """Once a minute at most: whoever attacks must not fill a log too."""
        now = self._loop.time()
        if now - self._told_at >= 60.0:
            self._told_at = now
            log.warning(text, what)


def _give_back() -> None:
    """Memory that is free, but between what is not: the C library keeps it for good, 50 kB of a connection with TLS."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # of glibc
    if trim is not None:
        trim(0)


def forget_frames(error: BaseException) -> None:
    """Let go of where a handshake failed: asyncio's frames there hold the error, and it them, with 256 KiB of buffers.

    Strangers fail hundreds of times a second, and all of that would wait for the collector: a gigabyte and more.
    """
    error.__traceback__ = None


def place_of(host: str) -> str:
    """What counts as one address: of IPv6 the network that one customer gets."""
    try:
        address = ipaddress.ip_address(host.partition("%")[0])
    except ValueError:
        return host
    if isinstance(address, ipaddress.IPv6Address):
        if address.ipv4_mapped is not None:
            return str(address.ipv4_mapped)
        return str(ipaddress.ip_network((address, 64), strict=False).network_address)
    return str(address)
