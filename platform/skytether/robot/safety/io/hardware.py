"""The gate's way to drivers that are no nodes of a graph: datagrams in and out. Nothing here waits.

They come and go on sockets of this machine that only those may open whom the file system lets, or over UDP to a
controller board. Another way (a graph, a field bus) is a kind in `skytether.robot.graphs`.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterable

from skytether.guard import wheels
from skytether.guard.descriptors import receive as receive_one
from skytether.guard.folder import ROOM, Known, sender
from skytether.guard.mailbox import bind
from skytether.messages import Message, PointCloud2

from ...graphs.inbox import Inbox, Topics

_LARGEST = 256 * 1024
"""Bytes of one reading; more is cut off and then no message."""
_LARGEST_CLOUD = 16 << 20
"""The same where one of them is a cloud of points."""
_EACH_TURN = 64
"""Readings taken in one turn of the loop; the rest waits in the socket's buffer, whose size the kernel bounds."""
_STOPS_EACH_TURN = 1024
"""More than the kernel keeps: after a stall all that waits is taken at once."""

Address = str | tuple[str, int]


class SocketWheels(wheels.SocketWheels):
    """Each velocity is a datagram: a geometry_msgs/msg/Twist as CDR."""

    def enable(self, level: bool) -> None:
        """Wheels: the guard has a line of its own for that."""


class SocketSensors:
    """Each reading is a datagram: the topic's name, a zero byte, the message as CDR. Stops have a socket of their own.

    Args:
        readings: To listen at for readings. A path that is left from before is taken over.
        stops: The same for what stops the robot, or the socket that somebody bound for it.
        topics: Which there are; others are named and not used, and so are those at the other socket.
        trouble: Told a kind and a sentence about each datagram that is not used.

    Raises:
        OSError: An address cannot be had.
    """

    def __init__(
        self,
        readings: Address,
        stops: Address | socket.socket,
        topics: Topics,
        trouble: Callable[[str, str], object],
    ) -> None:
        self._topics = topics
        self._trouble = trouble
        self._largest = _LARGEST_CLOUD if PointCloud2 in topics.kinds.values() else _LARGEST
        self._inbox = Inbox(topics, "cdr", trouble)
        self._readings = bind(readings)
        try:
            self._stops = stops if isinstance(stops, socket.socket) else bind(stops)
        except OSError:
            self._readings.close()
            raise
        self._known = {source: Known.of(source) for source in (self._readings, self._stops)}

    def stops(self) -> Iterable[tuple[str, Message]]:
        """Sensors: what waits in the socket for stops, all of it."""
        self._fill(self._stops, _STOPS_EACH_TURN, stops=True)
        return self._inbox.drain_stops()

    def read(self) -> Iterable[tuple[str, Message]]:
        """Sensors: what waits in the socket for readings."""
        self._fill(self._readings, _EACH_TURN, stops=False)
        return self._inbox.drain()

    def close(self) -> None:
        """Close the sockets."""
        self._readings.close()
        self._stops.close()

    def _fill(self, source: socket.socket, most: int, *, stops: bool) -> None:
        found, why = receive_known(source, self._known[source], self._largest, most)
        if why:
            self._trouble("sensors:sender", why)
        for data, _ in found:
            name, _, payload = data.partition(b"\0")
            topic = name[:64].decode("utf-8", errors="replace")
            if topic not in self._topics.kinds:
                self._trouble("sensors:topic", f"readings come for '{topic}', which is not configured")
            elif (topic in self._topics.stops) is not stops:
                where = "sockets.sensors" if stops else "sockets.estop"
                sentence = f"'{topic}' comes at the wrong socket and is not used; it belongs to {where}"
                self._trouble(f"sensors:{topic}:socket", sentence)
            else:
                self._inbox.put(topic, payload)


def receive_known(
    source: socket.socket, known: Known | None, largest: int, most: int
) -> tuple[list[tuple[bytes, object]], str]:
    """What waits in a socket that never waits, at most so many.

    Args:
        source: Whose senders are told, as `mailbox.bind` makes it.
        known: Who may send; None: everybody who can.
        largest: Bytes of each.
        most: So many, those included that are not used.

    Returns:
        Each with the address of its sender, who may send here; and what is to be said of others.
    """
    found: list[tuple[bytes, object]] = []
    wrong = ""
    for _ in range(most):
        try:
            data, ancillary, where = receive_one(source, largest, ROOM if known else 0)
        except BlockingIOError:
            break
        except OSError:  # what was sent before found nobody
            continue
        why = known.objection(*sender(ancillary)) if known else ""
        if why:
            wrong = f"what comes to {source.getsockname()} from another user is not used: {why}"
        else:
            found.append((data, where))
    return found, wrong
