"""The guard's ways to the wheels. Nothing here waits."""

from __future__ import annotations

import select
import socket
from collections.abc import Callable
from math import inf

from .clock import now
from .descriptors import receive
from .folder import check_listener
from .protocol import LARGEST, Beat, pack_beat, pack_twist, unpack_answer
from .teller import Sent
from .velocity import Velocity

Address = str | tuple[str, int]
"""A path, or a numeric host and a port: names are looked up before the guard starts."""


class SocketWheels:
    """Each velocity is a datagram: a geometry_msgs/msg/Twist as CDR.

    The socket is connected, so that a driver that ended is noticed even if the next one is there already.

    Args:
        address: Of whoever turns the wheels; it may come later, and come again.
        clock: `clock.now`; replaced by tests only.
    """

    def __init__(self, address: Address, clock: Callable[[], float] = now) -> None:
        self._address = address
        self._clock = clock
        self._socket: socket.socket | None = None

    def write(self, velocity: Velocity, until: float = inf) -> None:
        """Wheels: send it."""
        if self._socket is None:
            self._socket = _connected(self._address)
        if self._clock() > until:
            raise TimeoutError("this process stood still as it was about to tell them something")
        try:
            self._socket.send(pack_twist(velocity))
        except BlockingIOError:  # the same driver is there, and may read yet
            raise
        except OSError:
            self._socket.close()
            self._socket = None
            raise

    def full(self) -> bool:
        """Wheels: ask the kernel."""
        if self._socket is None:
            return False
        room = select.poll()
        room.register(self._socket, select.POLLOUT)
        return not room.poll(0)

    def unread(self) -> str:
        """Wheels: not known; a driver that does not read has no room left."""
        return ""

    def sent(self) -> Sent | None:
        """Wheels: nobody else sends it."""
        return None

    def listeners(self) -> frozenset[str] | None:
        """Wheels: not known; a driver that starts anew is a write that fails."""
        return None

    def hearers(self) -> frozenset[str]:
        """Wheels: not known."""
        return frozenset()

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()


class WriterWheels:
    """The wheels are on a graph: a writer, a process of its own, publishes what it is told.

    Args:
        link: To the writer; None: it has not been started. Replaced when it is started anew.
    """

    def __init__(self, link: socket.socket | None = None) -> None:
        self.link = link
        self.heard_at: float | None = None
        """When the writer last answered."""
        self.trouble = ""
        """What it said of the wheels."""

    def write(self, velocity: Velocity, at: float) -> None:
        """Have the wheels told.

        Args:
            velocity: Where they are to get; the writer gets them there, within the limits.
            at: When that was wanted [s].

        Raises:
            OSError: The writer is not there, or hangs.
        """
        if self.link is None:
            raise OSError("their writer is not there")
        self.link.send(pack_beat(Beat(at, velocity)))

    def lead_to(self, link: socket.socket | None) -> None:
        """Another writer, not heard yet, or none."""
        self.link, self.heard_at, self.trouble = link, None, ""

    def receive(self) -> None:
        """Take in that the writer is alive."""
        while self.link is not None:
            try:
                data = receive(self.link, LARGEST)[0]
            except OSError:  # nothing waits
                break
            if not data:
                break
            answer = unpack_answer(data)
            if answer is not None:
                self.heard_at, self.trouble = answer.at, answer.stopped


def family_of(address: Address) -> socket.AddressFamily:
    """The kind of socket that an address needs."""
    if isinstance(address, str):
        return socket.AF_UNIX
    return socket.AF_INET6 if ":" in address[0] else socket.AF_INET


def _connected(address: Address) -> socket.socket:
    made = socket.socket(family_of(address), socket.SOCK_DGRAM)
    made.setblocking(False)
    try:
        if isinstance(address, str):
            check_listener(address, "the wheels")
        made.connect(address)
    except OSError:
        made.close()
        raise
    return made
