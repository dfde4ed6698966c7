"""One end of a session on a real network: what applications see of it, from any thread.

The session runs in a thread with an event loop of its own (see `driver`). What an application does in its threads
never runs there, and what runs there never waits for it.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import math
import os
import selectors
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from types import TracebackType

from skytether.wire import Config, Session
from skytether.wire.codec.compression import compress
from skytether.wire.stats import SessionStats
from skytether.wire.topic import Role

from .calls import CallFailedError, Calls, Handler
from .datagrams import Address, DatagramSocket
from .driver import Driver
from .interfaces import LocalPath, Network, Wanted, Watcher, addresses, select
from .paths import LocalPaths, PeerNames, UsablePath
from .port import Port
from .spec import SessionSpec

_STATS_TIMEOUT = 2.0
_ENTRY_BYTES = 200
"""What a message costs beside its payload while it waits for the bridge's thread."""
_GATHER = 0.0003
"""Seconds for which messages are gathered when they come faster than that: then waking up for each, and a system call
for each, would cost more than all the rest."""
_SWITCH_INTERVAL = 0.0005
"""Seconds that the interpreter lets a thread of pure Python run on while the bridge's waits. With the usual 5 ms each
system call of the bridge may cost as much, and a round trip past a busy service takes 5 to 20 ms instead of 2."""


class BridgeError(Exception):
    """An endpoint cannot do what it was told; the text says what to change."""


def _check_port(what: str, port: int, least: int) -> None:
    """Refuse what is no port.

    Raises:
        ValueError: The text names the argument and the range.
    """
    if not least <= port <= 65_535:
        raise ValueError(f"{what}: port must be {least} to 65535, not {port}")


class Bridge:
    """Holds one end of a session: connects by itself, stays connected by itself, and moves messages.

    Every method may be called from any thread.

    Attributes:
        address: Host and port where it is bound, once started. A robot's end that nobody answers for seconds goes on
            from other ports, unless it was told which to take.
    """

    def __init__(
        self,
        spec: SessionSpec,
        port: Port,
        *,
        bind: tuple[str, int] = ("127.0.0.1", 0),
        peer: tuple[str, int] | None = None,
        paths: Wanted = (),
        config: Config | None = None,
    ) -> None:
        """Prepare; nothing is opened before `start`.

        Args:
            spec: The session and this end of it.
            port: The graph to join.
            bind: Local host and port; port 0 takes any free one. The robot's end needs an address from which
                the peer can be reached, "0.0.0.0" (or "::") for any.
            peer: Where the service's end listens; the robot's end needs it, now or by `set_peer`.
            paths: Networks that the robot's end uses side by side, or "auto": all that lead out of this machine. Found
                again each second. None (and while none of them is there): one socket, bound to `bind`.
            config: Of the protocol.

        Raises:
            ValueError: A port is out of its range, or paths is a word other than "auto", or the service's end has any:
                it learns its robot's.
        """
        _check_port("bind", bind[1], 0)
        if peer is not None:
            _check_port("peer", peer[1], 1)
        if isinstance(paths, str) and paths != "auto":
            raise ValueError(f"paths: must be 'auto' or a list of LocalPath, not '{paths}'")
        if paths and spec.role is not Role.ROBOT:
            raise ValueError("paths: only the robot's end has them; the service's end learns them")
        self._wanted: Wanted = paths
        self._watcher: Watcher | None = None
        self.address = bind
        self._spec = spec
        self._port = port
        self._peer = peer
        self._config = config or Config()
        self._sends = {t.name: t for t in spec.topics if t.direction.sender is spec.role}
        self._calls = Calls(spec.topics, spec.role, self.publish, int.from_bytes(os.urandom(8)))
        self._handover: deque[tuple[str, bytes, float]] = deque()
        self._handover_bytes = 0
        self._watched = False
        """Whether the bridge's thread is going to look at the handover."""
        self._looked_at = -math.inf
        self._overrun: Counter[str] = Counter()
        self._refused: Counter[str] = Counter()
        self._lock = threading.Lock()
        self._last_stats = SessionStats(connected=False)
        self._thread: threading.Thread | None = None
        self._stopping = False
        self._socket: DatagramSocket
        self._driver: Driver
        self._loop: asyncio.AbstractEventLoop

    def start(self) -> None:
        """Bind and begin; returns once packets are received. The session comes up later: `Port.notify` tells.

        Lowers the interpreter's thread switch interval (`sys.setswitchinterval`), for the whole process.

        Raises:
            BridgeError: The port is taken, the address is not this machine's, or the peer has no address.
        """
        if self._thread is not None:
            raise BridgeError("this bridge was started before; make a new one")
        host, port = self.address
        try:
            self._socket = DatagramSocket(self.address)
        except OSError as error:
            raise BridgeError(f"cannot listen on UDP {host}:{port}: {error.strerror or error}") from error
        with ExitStack() as undo:
            undo.callback(self._socket.close)
            self.address = self._socket.address
            spec = self._spec
            session = Session(
                spec.role, spec.id, spec.key, spec.topics, config=self._config, entropy=os.urandom, now=time.monotonic()
            )
            if self._peer is not None:
                session.set_peer(self._resolve(*self._peer))
            self._loop = new_loop(self._socket)
            undo.callback(self._loop.close)
            self._driver = Driver(session, self._socket, self._port, self._calls, self._loop)
            self._paths = LocalPaths(self._driver)
            self._names = PeerNames(self._socket.resolve)
            networks = self._names.known(self._local_paths() if self._wanted else {})
            # Before the port is told: what it publishes from then on waits for the thread, and is not refused.
            self._thread = threading.Thread(target=self._run, name=f"bridge-{self.address[1]}", daemon=True)
            undo.callback(setattr, self, "_thread", None)
            self._port.attach(self)
            undo.pop_all()
        sys.setswitchinterval(min(sys.getswitchinterval(), _SWITCH_INTERVAL))
        self._loop.call_soon(self._paths.use, networks)
        self._thread.start()
        if self._wanted:
            self._watcher = Watcher(self._local_paths, self._networks_changed, networks)

    def publish(self, topic: str, payload: bytes | memoryview) -> bool:
        if topic not in self._sends:
            raise KeyError(f"topic '{topic}' is not one that this end ({self._spec.role}) sends")
        size = len(payload) if isinstance(payload, bytes) else payload.nbytes
        if size > self._config.max_message:
            raise ValueError(
                f"topic '{topic}': {size} bytes are more than a message may have, {self._config.max_message}"
            )
        if self._thread is None:
            return self._refuse(topic)
        agreed = self._driver.agreed
        row = agreed.get(topic) or self._sends[topic]
        if topic not in agreed and (agreed or not row.reliable):
            return self._refuse(topic)
        # The caller may use its buffer again, so anything but bytes is copied; it compresses in its own time.
        payload = bytes(payload)
        if row.compression:
            payload = compress(payload)
        with self._lock:
            if self._stopping:
                self._refused[topic] += 1
                return False
            self._handover.append((topic, payload, time.monotonic()))
            self._handover_bytes += len(payload) + _ENTRY_BYTES
            while self._handover_bytes > self._config.queue_limit and len(self._handover) > 1:
                oldest, dropped, _ = self._handover.popleft()
                self._handover_bytes -= len(dropped) + _ENTRY_BYTES
                self._overrun[oldest] += 1
            wake, self._watched = not self._watched, True
        return not wake or self._soon(self._on_handover)

    def count_dropped(self, topic: str, count: int) -> None:
        with self._lock:
            self._overrun[topic] += count

    def call(self, name: str, payload: bytes | memoryview, timeout: float) -> bytes:
        """Ask the other end, and wait for its answer. Waits for a session too, as long as the time-out allows.

        Args:
            name: Of the call: this end sends the reliable topic ``NAME/request`` and receives ``NAME/response``.
            payload: The request, serialised.
            timeout: Seconds.

        Returns:
            The answer, serialised.

        Raises:
            CallTimeoutError: Nothing came in time; it may have been carried out all the same.
            CallFailedError: The other end cannot answer, was restarted or ended the session, or this is the bridge's
                own thread, which cannot wait.
            KeyError: This end does not make such a call.
            ValueError: The request is larger than the session's largest message.
        """
        if threading.current_thread() is self._thread:
            raise CallFailedError(f"call '{name}': a port's thread cannot wait for an answer; call from another")
        return self._calls.call(name, payload, timeout)

    def answer(self, name: str, handler: Handler) -> None:
        """Have calls of the other end answered by a function: serialised request in, serialised answer out.

        It runs in threads of its own, several at the same time, and raises `CallError` to tell the caller a reason.

        Raises:
            KeyError: This end does not answer such a call.
        """
        self._calls.answer(name, handler)

    @property
    def late_answers(self) -> int:
        """Answers to calls that came when nobody waited for them any more."""
        return self._calls.late

    def set_peer(self, host: str, port: int) -> None:
        """Speak to a service's end elsewhere from now on.

        Raises:
            BridgeError: The name has no address.
            ValueError: The port is out of its range.
        """
        _check_port("peer", port, 1)
        self._peer = (host, port)
        if self._thread is not None:
            address = self._resolve(host, port)
            self._soon(lambda: self._driver.set_peer(address))

    def set_cost(self, local: str, cost: int) -> None:
        """Use one of the `paths` less or more from now on: raising the cost of the one in use is a planned switch.

        Args:
            local: Interface or address, as it was named in `paths`.
            cost: 0 to 255.

        Raises:
            ValueError: The cost is out of its range.
        """
        path = LocalPath(local, cost)
        self._soon(lambda: self._paths.set_cost(path.local, path.cost))

    def stats(self) -> SessionStats:
        """A snapshot; after `stop` the last one."""
        return self._with_unseen(self._session_stats())

    def _session_stats(self) -> SessionStats:
        if threading.current_thread() is self._thread:
            return self._driver.stats()
        answer: concurrent.futures.Future[SessionStats] = concurrent.futures.Future()
        if self._soon(lambda: answer.set_result(self._driver.stats())):
            try:
                return answer.result(_STATS_TIMEOUT)
            except concurrent.futures.TimeoutError:
                pass  # stopped in between, or a port that does not return
        return self._last_stats

    def stop(self) -> None:
        """Say goodbye, end the thread, free the port. May be called again; from a port it does not wait."""
        with self._lock:
            first, self._stopping = not self._stopping, True
        if first and self._watcher is not None:
            self._watcher.close()
        if first:
            self._calls.close()
            self._soon(self._on_stop)
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()

    def __enter__(self) -> Bridge:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def _networks_changed(self, found: dict[Network, LocalPath]) -> dict[Network, UsablePath]:
        """In the watcher's thread: what can be used at once is, the rest when the name server has answered."""
        usable = self._names.known(found)
        self._soon(lambda: self._paths.use(usable))
        if len(usable) == len(found):
            return usable
        named = self._names.ask(found)
        self._soon(lambda: self._paths.use(named))
        return named

    # --- in the bridge's thread ------------------------------------------------------------------------------------

    def _run(self) -> None:
        self._loop.call_soon(self._driver.begin)
        try:
            self._loop.run_forever()
            # What others asked for meanwhile (statistics) gets its answer.
            self._loop.run_until_complete(asyncio.sleep(0))
        finally:
            self._loop.close()
            self._socket.close()

    def _on_handover(self) -> None:
        now = time.monotonic()
        with self._lock:
            messages, self._handover = self._handover, deque()
            self._handover_bytes = 0
            self._watched = again = bool(messages) and now < self._looked_at + _GATHER
        self._looked_at = now
        if again:
            self._loop.call_later(_GATHER, self._on_handover)
        if messages:
            self._driver.publish(messages)

    def _on_stop(self) -> None:
        self._on_handover()  # what was taken is sent, or counted
        self._driver.close()
        self._last_stats = self._driver.stats()
        self._loop.stop()

    def _local_paths(self) -> dict[Network, LocalPath]:
        return select(self._wanted, addresses(self._socket.family))

    # --- helpers ---------------------------------------------------------------------------------------------------

    def _refuse(self, topic: str) -> bool:
        with self._lock:
            self._refused[topic] += 1
        return False

    def _with_unseen(self, stats: SessionStats) -> SessionStats:
        """With messages that the session never saw: refused, or too many (those count as offered and replaced)."""
        with self._lock:
            refused, dropped = self._refused.copy(), self._overrun.copy()
        topics = tuple(
            replace(
                t,
                refused=t.refused + refused[t.topic],
                offered=t.offered + dropped[t.topic],
                replaced=t.replaced + dropped[t.topic],
            )
            if t.topic in refused or t.topic in dropped
            else t
            for t in stats.topics
        )
        return replace(stats, topics=topics)

    def _soon(self, callback: Callable[[], None]) -> bool:
        """Have something done in the bridge's thread; False if that has ended or was never started."""
        if self._thread is None:
            return False
        try:
            self._loop.call_soon_threadsafe(callback)
        except RuntimeError:  # the loop is closed
            return False
        return True

    def _resolve(self, host: str, port: int) -> Address:
        try:
            return self._socket.resolve(host, port)
        except OSError as error:
            raise BridgeError(f"peer {host}:{port} has no address: {error.strerror or error}") from error


def new_loop(sock: DatagramSocket) -> asyncio.AbstractEventLoop:
    """An event loop that keeps time to some microseconds.

    The default's epoll has its time-outs rounded up to milliseconds, which would be added to every copy and every
    paced burst; select has not, but it takes descriptors below 1024 only.
    """
    selector = selectors.SelectSelector()
    loop = asyncio.SelectorEventLoop(selector)
    try:
        selector.register(sock, selectors.EVENT_READ)
        selector.select(0)
        selector.unregister(sock)
    except ValueError:
        loop.close()
        return asyncio.SelectorEventLoop()
    return loop
