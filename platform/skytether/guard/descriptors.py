"""File descriptors that come along with a message (SCM_RIGHTS), and that nobody here asks for.

Whoever takes such a message closes what has no room in it, and who closes a descriptor last may have to wait: a socket
with SO_LINGER keeps that process for as long as it likes. `recv`, `read`, and `recvmsg` without room are no way out.
From Linux 6.16 on the kernel refuses the sender (SO_PASSRIGHTS); before, a thread does the closing.
"""

from __future__ import annotations

import os
import socket
import struct
import threading
from collections import deque
from contextlib import suppress

SO_PASSRIGHTS = 83
"""Linux, asm-generic/socket.h; Python does not name it."""
_MOST_SENT = 253
"""Of one message, as the kernel has it (SCM_MAX_FD)."""
_MOST_WAITING = 512
"""That wait for the thread; with more, no further message that has some is taken: its socket is silent then."""
_INT = struct.Struct("i")

Ancillary = list[tuple[int, int, bytes]]


def refuse(own: socket.socket) -> bool:
    """Have the kernel refuse messages with descriptors; before anybody can send one.

    Returns:
        Whether it does.
    """
    try:
        own.setsockopt(socket.SOL_SOCKET, SO_PASSRIGHTS, 0)
    except OSError:
        return False
    return True


def _refused() -> bool:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as one:
        return refuse(one)


REFUSED = _refused()
"""The kernel does, for every socket that asked it to."""


class Closer:
    """Closes descriptors in a thread of its own, which may wait as long as it likes.

    Args:
        most: How many wait for the thread, the one that it closes among them.
    """

    def __init__(self, most: int = _MOST_WAITING) -> None:
        self._most = most
        self._waiting: deque[int] = deque()
        self._there = threading.Semaphore(0)
        self._started = False

    def has_room(self) -> bool:
        """Whether more may come; starts the thread."""
        if not self._started:
            try:
                threading.Thread(target=self._run, name="closer", daemon=True).start()
            except (RuntimeError, MemoryError):
                return False
            self._started = True
        return len(self._waiting) < self._most

    def close(self, descriptors: list[int]) -> None:
        """Have them closed. Returns at once."""
        for one in descriptors:
            self._waiting.append(one)
            self._there.release()

    def _run(self) -> None:
        while True:
            self._there.acquire()
            with suppress(OSError):
                os.close(self._waiting[0])
            self._waiting.popleft()


CLOSER = Closer()


def receive(source: socket.socket, largest: int, room: int = 0) -> tuple[bytes, Ancillary, object]:
    """One message of a socket that never waits; nor does this, whatever came with it.

    Args:
        source: Whose kernel was asked to `refuse`.
        largest: Bytes; the rest is cut off.
        room: For what else is asked for, such as who sent it.

    Returns:
        The message, what else was asked for, and the address of the sender.

    Raises:
        BlockingIOError: Nothing waits, or what does cannot be taken now.
        OSError: As `recvmsg`.
    """
    held: list[int] = []
    if not REFUSED and source.family == socket.AF_UNIX:
        held = _hold(source, room)
    try:
        data, ancillary, _, sender = source.recvmsg(largest, room)
    finally:
        CLOSER.close(held)  # after the message has let go of them, so that this is the last close
    return data, ancillary, sender


def _hold(source: socket.socket, room: int) -> list[int]:
    """Take hold of the next message's descriptors, so that taking the message closes none of them for good.

    Raises:
        BlockingIOError: Nothing waits, or there is no room for all of them.
    """
    if not source.recvmsg(1, room, socket.MSG_PEEK)[2] & socket.MSG_CTRUNC:
        return []
    if not CLOSER.has_room():
        raise BlockingIOError
    room += socket.CMSG_SPACE(_MOST_SENT * _INT.size)
    _, ancillary, flags, _ = source.recvmsg(1, room, socket.MSG_PEEK | socket.MSG_CMSG_CLOEXEC)
    held = [
        number
        for level, kind, data in ancillary
        if (level, kind) == (socket.SOL_SOCKET, socket.SCM_RIGHTS)
        for (number,) in _INT.iter_unpack(data[: len(data) // _INT.size * _INT.size])
    ]
    if flags & socket.MSG_CTRUNC:  # this process has no room for all of them
        CLOSER.close(held)
        raise BlockingIOError
    return held
