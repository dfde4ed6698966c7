"""An emulated link between UDP programs, in user space: no privileges, own thread, conditions set live.

It stands between clients and one target as a NAT does: each client's address gets a port of its own towards
the target. What happens to a packet is decided in `link_model`; here are the sockets and the clock.
"""

from __future__ import annotations

import contextlib
import ctypes
import heapq
import itertools
import select
import socket
import threading
import time
from types import TracebackType

from skytether.bridge.datagrams import grow_buffers

from .link_model import LinkConditions, LinkCounters, LinkModel

__all__ = ["LinkConditions", "LinkCounters", "LinkEmulator"]

_TURN = 64
"""Datagrams taken from one socket before those that are due are sent on."""
_PR_SET_TIMERSLACK = 29


class LinkEmulator:
    """Forwards datagrams between clients and a target over a bad network.

    Runs from its construction until `close`. "Up" is from a client to the target, "down" the way back.

    Attributes:
        address: Where clients send to: host and port.
    """

    def __init__(
        self,
        target: tuple[str, int],
        *,
        up: LinkConditions | None = None,
        down: LinkConditions | None = None,
        bind: tuple[str, int] = ("127.0.0.1", 0),
    ) -> None:
        """Open the sockets and start.

        Raises:
            OSError: The port is taken or the address is not this machine's.
        """
        self._target = target
        self._up = LinkModel(up or LinkConditions(), "up")
        self._down = LinkModel(down or LinkConditions(), "down")
        self._front = _open(bind)
        self.address: tuple[str, int] = self._front.getsockname()
        self._backs: dict[tuple[str, int], socket.socket] = {}
        self._clients: dict[socket.socket, tuple[str, int]] = {}
        # Ordered by time, then by number, so that packets due at once keep their order. The address is None on the
        # way up: the target is looked up when the packet leaves.
        self._under_way: list[tuple[float, int, LinkModel, socket.socket, tuple[str, int] | None, bytes]] = []
        self._numbers = itertools.count()
        self._closing = False
        self._rebinding = False
        self._wake_out, self._wake_in = socket.socketpair()
        self._wake_out.setblocking(False)
        self._thread = threading.Thread(target=self._run, name=f"link-{self.address[1]}", daemon=True)
        self._thread.start()

    @property
    def up(self) -> LinkConditions:
        """Conditions from clients to the target."""
        return self._up.conditions

    @property
    def down(self) -> LinkConditions:
        """Conditions from the target to clients."""
        return self._down.conditions

    def set(self, *, up: LinkConditions | None = None, down: LinkConditions | None = None) -> None:
        """Change the conditions of one direction or both, for packets that enter from now on (a cut: all)."""
        if up is not None:
            self._up.conditions = up
        if down is not None:
            self._down.conditions = down

    def set_target(self, host: str, port: int) -> None:
        """Send to another target from now on, what is under way included."""
        self._target = (host, port)

    def rebind(self) -> None:
        """Forget all translations, as a NAT that restarts: the target sees every client at a new port."""
        self._rebinding = True
        self._wake_in.send(b".")

    def counters(self) -> dict[str, LinkCounters]:
        """What was done so far, by direction (``up``, ``down``)."""
        return {"up": self._up.counters.copy(), "down": self._down.counters.copy()}

    def close(self) -> None:
        """Drop what is under way, end the thread, close the sockets. May be called again."""
        if self._closing:
            return
        self._closing = True
        self._wake_in.send(b".")
        self._thread.join()
        for sock in (self._front, *self._clients, self._wake_in, self._wake_out):
            sock.close()

    def __enter__(self) -> LinkEmulator:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _run(self) -> None:
        keep_time()
        while not self._closing:
            wait = max(0.0, self._under_way[0][0] - time.monotonic()) if self._under_way else None
            # select, not epoll: its time-out has microseconds, epoll's is rounded up to milliseconds.
            for sock in select.select([self._wake_out, self._front, *self._clients], (), (), wait)[0]:
                if sock is self._wake_out:
                    self._obey()
                else:
                    self._receive(sock)
            self._forward(time.monotonic())

    def _obey(self) -> None:
        self._wake_out.recv(64)
        if self._rebinding:
            self._rebinding = False
            for sock in self._clients:
                sock.close()
            self._clients.clear()
            self._backs.clear()

    def _receive(self, sock: socket.socket) -> None:
        """Take what has arrived at one socket and decide its way."""
        if sock.fileno() < 0:  # closed by a rebind in this turn
            return
        model = self._up if sock is self._front else self._down
        for _ in range(_TURN):
            try:
                data, source = sock.recvfrom(65_535)
            except BlockingIOError:
                return
            except OSError:  # an ICMP answer to something sent before
                continue
            times = model.decide(len(data), time.monotonic())
            if not times:
                continue
            if model is self._up:
                way, address = self._back_of(source), None
            else:
                way, address = self._front, self._clients[sock]
            for due in times:
                heapq.heappush(self._under_way, (due, next(self._numbers), model, way, address, data))

    def _back_of(self, client: tuple[str, int]) -> socket.socket:
        """The socket that speaks to the target for this client."""
        back = self._backs.get(client)
        if back is None:
            back = self._backs[client] = _open((self.address[0], 0))
            self._clients[back] = client
        return back

    def _forward(self, now: float) -> None:
        """Send on what is due."""
        while self._under_way and self._under_way[0][0] <= now:
            due, _, model, sock, address, data = heapq.heappop(self._under_way)
            counters = model.counters
            if model.conditions.cut:
                counters.cut += 1
                continue
            try:
                sock.sendto(data, address or self._target)
            except OSError:
                counters.failed += 1
                continue
            now = time.monotonic()
            counters.forwarded += 1
            counters.bytes_forwarded += len(data)
            counters.late_total += now - due
            counters.late_max = max(counters.late_max, now - due)


def _open(bind: tuple[str, int]) -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        sock.setblocking(False)
        grow_buffers(sock)
        sock.bind(bind)
    except BaseException:
        sock.close()
        raise
    return sock


def keep_time() -> None:
    """Ask Linux not to delay this thread's timers by its usual 50 microseconds (prctl(2))."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)
