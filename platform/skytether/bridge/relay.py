"""A relay on real sockets: one public UDP port for many sessions, in a thread of its own (rule 9).

    with Relay(("0.0.0.0", 8700)) as relay:
        relay.add("0123456789abcdef", "10.0.0.7", 41000)

What is forwarded, and what not, is `relay_table`'s. Robots speak to the relay's public port as if it were the service;
to the service each of their addresses is a port of the relay's machine. Relays may stand in a row.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import resource
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial
from types import TracebackType
from typing import TypeVar

from .datagrams import Address, DatagramSocket
from .endpoint import BridgeError
from .relay_table import ID_DIGITS, Flow, Leg, Prefix, RelayLimits, RelayTable, same_session

_TURN = 8
"""Batches taken from one socket before the others get their turn."""
_LEG_BUFFER = 512 * 1024
"""Bytes that the kernel may hold for a leg, each way: 40 ms of 100 Mbit/s."""
_SPARE_FILES = 64
"""Descriptors that a process needs for everything else."""
_PATIENCE = 5.0

_T = TypeVar("_T")


@dataclass(frozen=True, slots=True)
class FlowStats:
    """What was forwarded of one session, or of all: packets and bytes of UDP payload."""

    packets_up: int = 0
    """From robots."""
    packets_down: int = 0
    bytes_up: int = 0
    bytes_down: int = 0
    dropped: int = 0
    """Packets above the rate."""
    addresses: tuple[str, ...] = ()
    """Of the session's robot."""


@dataclass(frozen=True, slots=True)
class RelayStats:
    """A snapshot."""

    sessions: dict[str, FlowStats] = field(default_factory=dict)
    """Those whose robot was answered, by id."""
    newcomers: FlowStats = FlowStats()
    """All addresses that are not admitted to a session, over all time."""
    legs: int = 0
    """Ports towards targets."""
    rejected: dict[str, int] = field(default_factory=dict)
    """Packets not forwarded, by bounded reason."""


class Relay:
    """Every method may be called from any thread.

    Attributes:
        address: Host and port where it is bound, once started.
    """

    def __init__(self, bind: tuple[str, int] = ("0.0.0.0", 0), *, limits: RelayLimits | None = None) -> None:  # noqa: S104 - a public port is what it is for
        """Prepare; nothing is opened before `start`.

        Args:
            bind: Local host and port; port 0 takes any free one.
            limits: Bounds.
        """
        self.address = bind
        self._limits = limits or RelayLimits()
        self._table = RelayTable(self._limits)
        self._scratch = memoryview(bytearray(65_536))
        self._errors: Counter[str] = Counter()
        """Of sockets that are closed by now."""
        self._last_stats = RelayStats()
        self._thread: threading.Thread | None = None
        self._stopped = False
        self._socket: DatagramSocket
        self._loop: asyncio.AbstractEventLoop

    def start(self) -> None:
        """Bind and begin; returns once packets are received.

        Raises:
            BridgeError: The port is taken, or the address is not this machine's.
        """
        if self._thread is not None:
            raise BridgeError("this relay was started before; make a new one")
        host, port = self.address
        try:
            self._socket = DatagramSocket(self.address, scratch=self._scratch)
        except OSError as error:
            raise BridgeError(f"cannot listen on UDP {host}:{port}: {error.strerror or error}") from error
        self.address = self._socket.address
        _allow_files(self._limits.sessions * self._limits.addresses + self._limits.newcomers + _SPARE_FILES)
        self._loop = asyncio.new_event_loop()
        self._loop.add_reader(self._socket, self._on_public)
        self._loop.call_soon(self._sweep)
        self._thread = threading.Thread(target=self._run, name=f"relay-{self.address[1]}", daemon=True)
        self._thread.start()

    def add(self, sessions: str, host: str, port: int) -> None:
        """Route sessions to where their service's end, or the next relay, listens; replaces what was said before.

        Args:
            sessions: A session's 16 hexadecimal digits, or its first ones and ``*``; the longest that fits counts.
            host: Of the target.
            port: Of the target.

        Raises:
            ValueError: ``sessions`` is no such text.
            BridgeError: The target has no address or is the relay itself, or the relay is not started.
        """
        prefix = Prefix.parse(sessions)
        try:
            family, _, _, _, found = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        except OSError as error:
            raise BridgeError(f"target {host}:{port} has no address: {error.strerror or error}") from error
        target = (str(found[0]), int(found[1])) if family == socket.AF_INET else found
        if port == self.address[1] and _is_ours(host):
            raise BridgeError(f"target {host}:{port} is the relay itself; name where the sessions' services listen")
        self._call(lambda: self._table.add(prefix, target, time.monotonic()))  # type: ignore[arg-type]  # typeshed allows for other families

    def remove(self, sessions: str) -> bool:
        """Forward these sessions no longer; False if there is no such route.

        Raises:
            ValueError: ``sessions`` is not what `add` takes.
            BridgeError: The relay is not started.
        """
        prefix = Prefix.parse(sessions)
        removed = self._call(lambda: self._table.remove(prefix))
        self._call(self._close_ended)
        return removed

    def stats(self) -> RelayStats:
        """A snapshot; after `stop` the last one."""
        try:
            return self._call(self._collect_stats)
        except BridgeError:
            return self._last_stats

    def stop(self) -> None:
        """End the thread and free the ports. May be called again."""
        if self._thread is None:
            return
        if not self._stopped:
            self._stopped = True
            with contextlib.suppress(RuntimeError):
                self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()

    def __enter__(self) -> Relay:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def _call(self, function: Callable[[], _T]) -> _T:
        """Have something done in the relay's thread, and return what it returns."""
        if self._thread is None or self._stopped:
            raise BridgeError("the relay is not running; start it first")
        answer: concurrent.futures.Future[_T] = concurrent.futures.Future()
        try:
            self._loop.call_soon_threadsafe(lambda: answer.set_result(function()))
            return answer.result(_PATIENCE)
        except (RuntimeError, concurrent.futures.TimeoutError) as error:
            raise BridgeError("the relay is not running; start it first") from error

    # --- in the relay's thread -------------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            self._loop.run_forever()
            self._loop.run_until_complete(asyncio.sleep(0))  # who waits for an answer gets it
            self._last_stats = self._collect_stats()
        finally:
            for route in self._table.routes:
                self._table.remove(route.prefix)
            self._close_ended()
            self._loop.remove_reader(self._socket)
            self._socket.close()
            self._loop.close()

    def _sweep(self) -> None:
        self._table.expire(time.monotonic())
        self._close_ended()
        self._loop.call_later(1.0, self._sweep)

    def _on_public(self) -> None:
        for _ in range(_TURN):
            batch = self._socket.receive()
            if batch is None:
                break
            now = time.monotonic()
            for data, segment, count in same_session(batch[0], batch[2]):
                leg = self._table.up(data, batch[1], now, count)
                if leg is not None and (leg.port is not None or self._open(leg)):
                    self._send(leg.port, data, leg.route.target, segment)
        self._close_ended()

    def _on_leg(self, leg: Leg) -> None:
        for _ in range(_TURN):
            batch = leg.port.receive()
            if batch is None:
                break
            now = time.monotonic()
            for data, segment, count in same_session(batch[0], batch[2]):
                if self._table.down(leg, data, batch[1], now, count):
                    self._send(self._socket, data, leg.source, segment)

    def _open(self, leg: Leg) -> bool:
        """Give a leg its port."""
        anywhere = "::" if ":" in leg.route.target[0] else "0.0.0.0"  # noqa: S104 - the system picks the way out
        try:
            leg.port = DatagramSocket((anywhere, 0), kernel_buffer=_LEG_BUFFER, scratch=self._scratch)
        except OSError:  # no descriptors left
            self._table.rejected["no_port"] += 1
            self._table.close(leg)
            return False
        self._loop.add_reader(leg.port, partial(self._on_leg, leg))
        return True

    def _close_ended(self) -> None:
        closed = self._table.closed
        while closed:
            port = closed.popleft().port
            if port is not None:
                self._errors.update(port.errors)
                self._loop.remove_reader(port)
                port.close()

    def _send(self, port: DatagramSocket, data: memoryview, address: Address, segment: int | None) -> None:
        """Send now or never: what waits in a relay is late."""
        if port.send(data, address, segment) < len(data):
            self._table.rejected["socket_full"] += 1

    def _collect_stats(self) -> RelayStats:
        table = self._table
        newcomers = [route.flow for route in table.routes]
        errors = self._errors + self._socket.errors
        for leg in table.legs:
            if leg.port is not None:
                errors.update(leg.port.errors)
        refused = {f"socket_{name.lower()}": count for name, count in errors.items()}
        return RelayStats(
            {f"{number:0{ID_DIGITS}x}": _flow([s], s.legs) for number, s in table.sessions.items()},
            _flow(newcomers),
            len(table.legs),
            {**table.rejected, **refused},
        )


def _flow(flows: Sequence[Flow], addresses: Iterable[Address] = ()) -> FlowStats:
    return FlowStats(
        sum(f.packets_up for f in flows),
        sum(f.packets_down for f in flows),
        sum(f.bytes_up for f in flows),
        sum(f.bytes_down for f in flows),
        sum(f.dropped for f in flows),
        tuple(show_address(a[0], a[1]) for a in addresses),
    )


def show_address(host: str, port: int) -> str:
    """As people write it."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def _is_ours(host: str) -> bool:
    """Whether an address is this machine's: only then can a socket be bound to it."""
    try:
        DatagramSocket((host, 0)).close()
    except OSError:
        return False
    return True


def _allow_files(count: int) -> None:
    """Let this process open so many files, or as many as its user may; what is beyond counts as ``no_port``."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    most = count if hard == resource.RLIM_INFINITY else min(count, hard)
    if soft != resource.RLIM_INFINITY and soft < most:
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))
