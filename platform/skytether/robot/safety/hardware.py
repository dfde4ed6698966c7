"""The gate's way to the robot's own hardware: readings in, velocities out. Nothing here waits.

Whoever has another way (a field bus, a graph) implements `Sensors` and `Wheels`. These speak datagrams, on sockets of
this machine that only those may open whom the file system lets, or over UDP to a controller board.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Protocol

from skytether.guard import wheels
from skytether.guard.protocol import Told
from skytether.guard.velocity import Velocity
from skytether.messages import DecodeError, Message, decode

_LARGEST = 256 * 1024
"""Bytes of one reading; more is cut off and then no message."""
_EACH_TURN = 64
"""Readings taken in one turn of the loop; the rest waits in the socket's buffer, whose size the kernel bounds."""

Address = str | tuple[str, int]


class Wheels(Protocol):
    """Where velocities go."""

    def write(self, velocity: Velocity) -> None:
        """What the wheels do until the next call. Returns at once.

        Raises:
            OSError: It did not get there.
        """
        ...

    def listeners(self) -> frozenset[str] | None:
        """Who listens to the velocities now, each under a name that is another after it was away; None: not known."""
        ...

    def close(self) -> None:
        """Let go of it."""
        ...


class Sensors(Protocol):
    """Where readings come from."""

    def read(self) -> Iterable[tuple[str, Message]]:
        """What came since the last call, by topic, oldest first. Returns at once and never raises."""
        ...

    def close(self) -> None:
        """Let go of it."""
        ...


class SocketWheels:
    """Each velocity is a datagram: a geometry_msgs/msg/Twist as CDR.

    Args:
        address: Of whoever turns the wheels; it may come later, and come again.
    """

    def __init__(self, address: Address) -> None:
        self._wheels = wheels.SocketWheels(address)

    def write(self, velocity: Velocity) -> None:
        """Wheels: send it."""
        self._wheels.write(velocity, Told(), 0.0)

    def listeners(self) -> frozenset[str] | None:
        """Wheels: not known."""
        return None

    def close(self) -> None:
        """Close the socket."""
        self._wheels.close()


class SocketSensors:
    """Each reading is a datagram: the topic's name, a zero byte, the message as CDR.

    Args:
        address: To listen at. A path that is left from before is taken over.
        kinds: Type of the messages of each topic; others are counted and not used.
        trouble: Told a kind and a sentence about each datagram that is not used.

    Raises:
        OSError: The address cannot be had.
    """

    def __init__(
        self, address: Address, kinds: Mapping[str, type[Message]], trouble: Callable[[str, str], object]
    ) -> None:
        self._kinds = kinds
        self._trouble = trouble
        self._socket = bind(address, 0o660)

    def read(self) -> Iterable[tuple[str, Message]]:
        """Sensors: what waits in the socket."""
        found = []
        for data in receive(self._socket, _LARGEST, _EACH_TURN):
            name, _, payload = data.partition(b"\0")
            topic = name[:64].decode("utf-8", errors="replace")
            kind = self._kinds.get(topic)
            if kind is None:
                self._trouble("sensors:topic", f"readings come for '{topic}', which is not configured")
                continue
            try:
                found.append((topic, decode(kind, payload)))
            except DecodeError as error:
                self._trouble(f"sensors:{topic}:bytes", f"{topic}: {error}")
        return found

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


def bind(address: Address, mode: int) -> socket.socket:
    """A datagram socket that never waits; a path gets its mode before anybody can send.

    Raises:
        OSError: The address cannot be had.
    """
    made = _datagrams(address)
    try:
        if isinstance(address, str):
            path = Path(address)
            with suppress(FileNotFoundError):
                path.unlink()
            made.bind(address)
            path.chmod(mode)
        else:
            made.bind(address)
    except OSError:
        made.close()
        raise
    return made


def receive_from(source: socket.socket, largest: int, most: int) -> list[tuple[bytes, object]]:
    """What waits in a socket that never waits, and who sent it, at most so many."""
    found: list[tuple[bytes, object]] = []
    while len(found) < most:
        try:
            found.append(source.recvfrom(largest))
        except BlockingIOError:
            break
        except OSError:  # what was sent before found nobody
            continue
    return found


def receive(source: socket.socket, largest: int, most: int) -> list[bytes]:
    """What waits in a socket that never waits, at most so many."""
    found: list[bytes] = []
    while len(found) < most:
        try:
            found.append(source.recv(largest))
        except BlockingIOError:
            break
        except OSError:  # what was sent before found nobody: that is said by the next write
            continue
    return found


def _datagrams(address: Address) -> socket.socket:
    family = socket.AF_UNIX if isinstance(address, str) else socket.AF_INET6 if ":" in address[0] else socket.AF_INET
    made = socket.socket(family, socket.SOCK_DGRAM)
    made.setblocking(False)
    return made
