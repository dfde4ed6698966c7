"""Wheels and sensors on the gate's own datagram sockets."""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol

from skytether.guard.clock import now
from skytether.guard.velocity import Velocity
from skytether.messages import DecodeError, Message, Twist, decode, encode

from .checker import SentVelocity
from .record import WheelRecord

_SO_TIMESTAMPNS = 35
"""Of Linux; `socket` has no name for it. The kernel stamps each datagram in the call that sends it."""
_TIME = struct.Struct("ll")
_CREDENTIALS = struct.Struct("iII")
_LOOK_S = 0.05
_AT_ONCE_S = 0.001
"""Two clocks that are read within this are read at the same moment."""


class Hardware(Protocol):
    """What a robot is made of, played."""

    record: WheelRecord
    section: Mapping[str, Any]
    """What the section ``safety`` says of the way to it."""

    def send(self, topic: str, message: Message) -> None:
        """A reading; lost if nobody takes it. From any thread."""
        ...

    def vanish(self) -> None:
        """The wheels' driver ends."""
        ...

    def appear(self) -> None:
        """The wheels' driver starts."""
        ...

    def close(self) -> None:
        """End it all."""
        ...


class SocketHardware:
    """Remembers with each velocity when it was sent, as the kernel saw it, and by whom.

    Args:
        folder: Of the gate's sockets.
    """

    section: Mapping[str, Any] = {}

    def __init__(self, folder: Path) -> None:
        self.record = WheelRecord()
        self._folder = folder
        self._ended = threading.Event()
        self._wheels: socket.socket | None = None
        self._hangs_until = 0.0
        self._sends = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._sends.setblocking(False)
        self._thread = threading.Thread(target=self._receive, name="wheels")
        self.appear()
        self._thread.start()

    def send(self, topic: str, message: Message) -> None:
        """Hardware: a datagram."""
        path = self._folder / ("estop.sock" if topic == "estop" else "sensors.sock")
        with suppress(OSError):  # the gate is not there, or does not take it: so much the worse for it
            self._sends.sendto(topic.encode() + b"\0" + encode(message), str(path))

    def vanish(self) -> None:
        """Hardware: nobody listens at the wheels' socket."""
        with suppress(FileNotFoundError):
            (self._folder / "wheels.sock").unlink()
        gone, self._wheels = self._wheels, None
        if gone is not None:
            gone.close()

    def appear(self) -> None:
        """Hardware: listen at the wheels' socket."""
        made = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        made.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        made.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
        made.settimeout(_LOOK_S)
        made.bind(str(self._folder / "wheels.sock"))
        self._wheels = made

    def hang(self, seconds: float) -> None:
        """The wheels' driver does not read what it is sent for a while [s]; then it reads all."""
        self._hangs_until = now() + seconds

    def close(self) -> None:
        """Hardware: end the thread, close the sockets."""
        self._ended.set()
        self._thread.join()
        self.vanish()
        self._sends.close()

    def _receive(self) -> None:
        while not self._ended.is_set():
            listens = self._wheels
            if listens is None or now() < self._hangs_until:
                self._ended.wait(0.005)
                continue
            try:
                data, more, _, _ = listens.recvmsg(256, 128)
            except TimeoutError:
                continue
            except OSError:  # it vanished meanwhile
                continue
            self._on_velocity(data, more)

    def _on_velocity(self, data: bytes, more: list[tuple[int, int, bytes]]) -> None:
        try:
            twist = decode(Twist, data)
        except DecodeError:
            return
        at, sender = now(), 0
        for _, kind, value in more:
            if kind == _SO_TIMESTAMPNS:
                seconds, nanoseconds = _TIME.unpack(value[: _TIME.size])
                at = steady(seconds + nanoseconds * 1e-9)
            elif kind == socket.SCM_CREDENTIALS:
                sender = _CREDENTIALS.unpack(value[: _CREDENTIALS.size])[0]
        self.record.add(SentVelocity(at, Velocity(twist.linear.x, twist.angular.z), sender))


def steady(wall_s: float, clock: Callable[[], float] = now, wall_clock: Callable[[], float] = time.time) -> float:
    """When it was that time of day [s], on the clock of everything else here [s].

    Read until both clocks are read at once: a judge that lost the processor between them would take a velocity for one
    that was told earlier than it was, and so for a jump.
    """
    before = clock()
    while True:
        ago = wall_clock() - wall_s
        after = clock()
        if after - before < _AT_ONCE_S:
            return after - ago
        before = after
