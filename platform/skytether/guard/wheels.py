"""The guard's ways to the wheels. Nothing here waits."""

from __future__ import annotations

import socket
from typing import Protocol

from .protocol import LARGEST, Answer, Beat, Told, pack_beat, pack_twist, unpack_answer
from .velocity import Velocity

Address = str | tuple[str, int]
"""A path, or a numeric host and a port: names are looked up before the guard starts."""


class Wheels(Protocol):
    """Where velocities go."""

    def write(self, velocity: Velocity, wrote: Told, now: float) -> Told | None:
        """Tell the wheels.

        Args:
            velocity: Wanted.
            wrote: What the guard knows that they were told last.
            now: [s]

        Returns:
            What they were told by this; None: that is known later, by `hear`.

        Raises:
            OSError: It did not get there.
        """
        ...

    def hear(self) -> Told | None:
        """What they were told, as known since the last call; None: nothing new."""
        ...


class SocketWheels:
    """Each velocity is a datagram: a geometry_msgs/msg/Twist as CDR.

    The socket is connected, so that a driver that ended is noticed even if the next one is there already.

    Args:
        address: Of whoever turns the wheels; it may come later, and come again.
    """

    def __init__(self, address: Address) -> None:
        self._address = address
        self._socket: socket.socket | None = None

    def write(self, velocity: Velocity, wrote: Told, now: float) -> Told | None:  # noqa: ARG002 - of the contract
        """Wheels: send it."""
        if self._socket is None:
            self._socket = _connected(self._address)
        try:
            self._socket.send(pack_twist(velocity))
        except OSError:
            self._socket.close()
            self._socket = None
            raise
        return Told(velocity, now)

    def hear(self) -> Told | None:
        """Wheels: nothing comes later."""
        return None

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

    def write(self, velocity: Velocity, wrote: Told, now: float) -> Told | None:
        """Wheels: have it published."""
        if self.link is None:
            raise OSError("their writer is not there")
        self.link.send(pack_beat(Beat(now, velocity, wrote)))
        return None

    def hear(self) -> Told | None:
        """Wheels: what the writer said."""
        newest: Answer | None = None
        while self.link is not None:
            try:
                data = self.link.recv(LARGEST)
            except OSError:  # nothing waits
                break
            if not data:
                break
            newest = unpack_answer(data) or newest
        if newest is None:
            return None
        self.heard_at = newest.at
        return newest.told


def family_of(address: Address) -> socket.AddressFamily:
    """The kind of socket that an address needs."""
    if isinstance(address, str):
        return socket.AF_UNIX
    return socket.AF_INET6 if ":" in address[0] else socket.AF_INET


def _connected(address: Address) -> socket.socket:
    made = socket.socket(family_of(address), socket.SOCK_DGRAM)
    made.setblocking(False)
    try:
        made.connect(address)
    except OSError:
        made.close()
        raise
    return made
