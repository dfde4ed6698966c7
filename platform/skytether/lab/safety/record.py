"""What the wheels received, with the moment at which each velocity was sent, as the kernel saw it."""

from __future__ import annotations

import socket
import struct
import threading
import time
from bisect import bisect_left
from collections import deque
from contextlib import suppress
from pathlib import Path

from skytether.guard.clock import now
from skytether.guard.velocity import STANDSTILL, Velocity
from skytether.messages import DecodeError, Twist, decode

from .checker import Told

_SO_TIMESTAMPNS = 35
"""Of Linux; `socket` has no name for it. The kernel stamps each datagram in the call that sends it."""
_TIME = struct.Struct("ll")
_CREDENTIALS = struct.Struct("iII")
_LONGEST = 200_000
"""Velocities that are kept: an hour at 50 Hz. Of a flood the oldest go."""
_LOOK_S = 0.05


class WheelRecord:
    """Plays the wheels at a datagram socket: remembers, and may be gone for a while.

    Args:
        path: Of the socket.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._told: deque[Told] = deque([Told(now(), STANDSTILL)], _LONGEST)
        self._ended = threading.Event()
        self._socket: socket.socket | None = None
        self._thread = threading.Thread(target=self._receive, name="wheels")
        self.appear()
        self._thread.start()

    @property
    def last(self) -> Told:
        """What they were told last; they begin with a standstill."""
        return self._told[-1]

    def add(self, told: Told) -> None:
        """Remember one more; for wheels that listen elsewhere."""
        self._told.append(told)

    def since(self, start: float) -> list[Told]:
        """Everything from a moment on, in order of time, and the last before it."""
        told = sorted(self._told.copy(), key=lambda told: told.at)
        first = bisect_left(told, start, key=lambda told: told.at)
        return told[max(0, first - 1) :]

    def vanish(self) -> None:
        """The wheels' driver ends."""
        with suppress(FileNotFoundError):
            self._path.unlink()
        gone, self._socket = self._socket, None
        if gone is not None:
            gone.close()

    def appear(self) -> None:
        """The wheels' driver starts."""
        made = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        made.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        made.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
        made.settimeout(_LOOK_S)
        made.bind(str(self._path))
        self._socket = made

    def close(self) -> None:
        """End the thread, close the socket."""
        self._ended.set()
        self._thread.join()
        self.vanish()

    def _receive(self) -> None:
        while not self._ended.is_set():
            listens = self._socket
            if listens is None:
                self._ended.wait(0.005)
                continue
            try:
                data, more, _, _ = listens.recvmsg(256, 128)
            except TimeoutError:
                continue
            except OSError:  # it vanished meanwhile
                continue
            self._take(data, more)

    def _take(self, data: bytes, more: list[tuple[int, int, bytes]]) -> None:
        try:
            twist = decode(Twist, data)
        except DecodeError:
            return
        at, sender = now(), 0
        for _, kind, value in more:
            if kind == _SO_TIMESTAMPNS:
                seconds, nanoseconds = _TIME.unpack(value[: _TIME.size])
                at -= time.time() - (seconds + nanoseconds * 1e-9)
            elif kind == socket.SCM_CREDENTIALS:
                sender = _CREDENTIALS.unpack(value[: _CREDENTIALS.size])[0]
        self._told.append(Told(at, Velocity(twist.linear.x, twist.angular.z), sender))
