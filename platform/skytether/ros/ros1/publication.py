"""One topic that the node publishes: its subscribers, each with a bounded queue, and the latched message."""

from __future__ import annotations

import asyncio
import fcntl
import logging
import socket
import struct
import termios
import threading
import time
from collections import deque
from collections.abc import Callable, Collection
from contextlib import AbstractContextManager, nullcontext, suppress
from math import inf
from typing import NamedTuple

from skytether.guard.clock import now as boottime
from skytether.ros.names import ros1_type
from skytether.ros.ros2.native.side.comers import FINDS_S, Comers

from .tcpros import ANY, pack_frame, pack_header, sums_differ

_log = logging.getLogger(__name__)

QUEUE = 100
"""Messages that may wait for one subscriber that is too slow; the oldest are dropped beyond."""
QUEUE_BYTES = 32 * 2**20
"""The same in bytes."""
_WRITTEN_BYTES = 2**16
"""What may wait in a connection's own buffer before the queue is used."""
_HANDOVER = 1000
"""Messages on the way from other threads to the node's; they wait there for milliseconds."""
_MAX_SUBSCRIBERS = 256
_MISSED_S, _MOST_DOUBLED = 1.0, 5
"""Until a node is told anew that this one publishes, doubled each time, but no more often than that."""
_MOST_UNREAD = 4096
"""Frames of which it is known when they were put."""


Speaking = Callable[[], AbstractContextManager[None]]


class _Frame(NamedTuple):
    """What goes to subscribers."""

    data: bytes
    until: float = inf
    """When it is too old for that [s, as `boottime`]."""
    put_at: float = -inf
    """When it was wanted, where it is to be known whether it got there [s]."""


class _Subscriber:
    """One connection."""

    def __init__(
        self,
        caller: str,
        writer: asyncio.StreamWriter,
        queue: int,
        clock: Callable[[], float] = boottime,
        speaking: Speaking = nullcontext,
    ) -> None:
        self.caller = caller
        self.writer = writer
        self.dropped = 0
        self._clock = clock
        self._speaking = speaking
        self._limit = queue
        self._written = 0
        """Bytes that the connection was given."""
        self._unread: deque[tuple[int, float]] = deque(maxlen=_MOST_UNREAD)
        """Of those frames that have not got there, so far as is known: bytes to their ends, and when they were put."""
        self._forgets = False
        """Whether the kernel gives up what is on its way when the connection is closed."""
        self.read_at = clock()
        """When the last was put that the other computer has [s]; at first, since when it is there."""
        self._queue: deque[_Frame] = deque()
        self._bytes = 0
        self._draining: asyncio.Task[None] | None = None
        writer.transport.set_write_buffer_limits(_WRITTEN_BYTES)

    def send(self, frame: _Frame) -> None:
        if self._draining is None and self.writer.transport.get_write_buffer_size() < _WRITTEN_BYTES:
            self._write(frame)
            return
        self._queue.append(frame)
        self._bytes += len(frame.data)
        while len(self._queue) > self._limit or (self._bytes > QUEUE_BYTES and len(self._queue) > 1):
            self._bytes -= len(self._queue.popleft().data)
            self.dropped += 1
        if self._draining is None:
            self._draining = asyncio.ensure_future(self._drain())

    async def _drain(self) -> None:
        try:
            while self._queue:
                await self.writer.drain()
                if self._queue:
                    frame = self._queue.popleft()
                    self._bytes -= len(frame.data)
                    self._write(frame)
        except OSError:
            self._queue.clear()  # the connection's reader notices its end
        finally:
            self._draining = None

    def _write(self, frame: _Frame) -> None:
        """Right before it goes, for this process may have stood still since it was wanted."""
        with self._speaking():
            if self._clock() <= frame.until:
                self.writer.write(frame.data)
                self._written += len(frame.data)
            else:
                self.dropped += 1
                return
        if frame.put_at > -inf:
            if not self._forgets:
                # What has not got there by the end of this process is not sent again after it.
                sock = self.writer.get_extra_info("socket")
                with suppress(OSError):  # the connection has just ended, and others wait for the frame
                    sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                self._forgets = True
            self._unread.append((self._written, frame.put_at))

    def see_read(self) -> float:
        """Ask the kernel what the other computer has acknowledged; from one thread, any.

        Returns:
            For how long the oldest frame that it has not is on its way [s]; 0: it has all.
        """
        read, transport = self._written, self.writer.transport
        try:
            read -= transport.get_write_buffer_size() + _unacknowledged(transport.get_extra_info("socket"))
        except (OSError, ValueError):  # it has just ended
            return 0.0
        while self._unread and self._unread[0][0] <= read:
            self.read_at = self._unread.popleft()[1]
        try:
            return max(0.0, self._clock() - self._unread[0][1])
        except IndexError:
            return 0.0

    def close(self) -> None:
        if self._draining is not None:
            self._draining.cancel()
        self.writer.close()


def _unacknowledged(sock: socket.socket) -> int:
    """Bytes in a TCP connection that the other end's kernel has not acknowledged, of Linux."""
    return int(struct.unpack("i", fcntl.ioctl(sock.fileno(), termios.TIOCOUTQ, bytes(4)))[0])


class Heard(NamedTuple):
    """How far what is published has got."""

    at: float
    """When the last was put that the computers of all who listen have [s]."""
    unread: tuple[str, ...]
    """Who has not, for longer than he may."""


class Publication:
    """Made by `Node.advertise`; `publish` may be called from any thread.

    Attributes:
        topic: Absolute name.
        type: As ROS 1 has it, ``sensor_msgs/LaserScan``.
        md5: Of the type.
        renewed: How often somebody began to listen who may have left before, or is awaited.
    """

    def __init__(
        self,
        node: str,
        soon: Callable[[Callable[[], None]], bool],
        topic: str,
        kind: str,
        md5: str,
        definition: str,
        *,
        latched: bool,
        queue: int,
        hold_s: float = 0.0,
        speaking: Speaking = nullcontext,
        clock: Callable[[], float] = boottime,
        awaited: Collection[str] = (),
    ) -> None:
        self.topic = topic
        self.type = ros1_type(kind)
        self.md5 = md5
        self._header = pack_header(
            {
                "callerid": node,
                "topic": topic,
                "type": self.type,
                "md5sum": md5,
                "message_definition": definition,
                "latching": "1" if latched else "0",
            }
        )
        self._node = node
        self._soon = soon
        self._latched = latched
        self._queue = queue
        self._hold_s = hold_s
        self._held: deque[tuple[float, bytes]] = deque(maxlen=queue)
        self._newest: bytes | None = None
        self._lock = threading.Lock()
        self._speaking = speaking
        self._clock = clock
        self._handover: deque[tuple[_Frame, int | None]] = deque(maxlen=_HANDOVER)
        self._subscribers: list[_Subscriber] = []
        self.renewed = 0
        self._awaited = frozenset(awaited)
        self._comers, self._began = Comers(awaited), clock()
        self._refused: set[tuple[str, str]] = set()
        self._missed: dict[str, tuple[int, float]] = {}
        """Nodes whose connections have ended: how often each was told anew, and when it is next [s]."""

    @property
    def subscribers(self) -> list[str]:
        """Names of the nodes that listen now."""
        return [subscriber.caller for subscriber in list(self._subscribers)]

    def publish(self, payload: bytes | memoryview, until: float = inf, renewed: int | None = None) -> None:
        """Send a serialised message to everybody who listens; never blocks.

        Args:
            payload: The message.
            until: Not sent after that [s, `skytether.guard.clock.now`]: another thread sends it, which may stand still
                meanwhile.
            renewed: Nor once `renewed` is more than that: it would be a first word for who came.
        """
        frame = pack_frame(payload)
        with self._lock:
            first = not self._handover
            self._handover.append((_Frame(frame, until, self._clock() if until < inf else -inf), renewed))
        if first:
            self._soon(self._flush)

    def _flush(self) -> None:
        with self._lock:
            waiting, self._handover = self._handover, deque(maxlen=_HANDOVER)
        frames = [frame for frame, renewed in waiting if renewed is None or renewed == self.renewed]
        if not frames:
            return
        if self._latched:
            self._newest = frames[-1].data
        for subscriber in self._subscribers:
            for frame in frames:
                subscriber.send(frame)
        if self._hold_s and not self._subscribers:
            held_until = time.monotonic() + self._hold_s
            self._held.extend((held_until, frame.data) for frame in frames)

    async def serve(self, header: dict[str, str], reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """In the node's thread: a subscriber has connected. Returns when it is gone."""
        caller = header.get("callerid", "somebody")
        refusal = self._refusal(caller, header)
        if refusal:
            writer.write(pack_header({"error": refusal}))
            await writer.drain()
            return
        writer.write(self._header)
        subscriber = _Subscriber(caller, writer, self._queue, self._clock, self._speaking)
        if self._latched and self._newest is not None:
            subscriber.send(_Frame(self._newest))
        while self._held:
            until, frame = self._held.popleft()
            if time.monotonic() < until:
                subscriber.send(_Frame(frame))
        self._subscribers.append(subscriber)
        self._missed.pop(caller, None)
        self.renewed += self._is_anybody_back()
        try:
            while await reader.read(4096):
                pass
            writer.transport.abort()  # it may read no more, and what waits for that would keep the file descriptor
        finally:
            self._subscribers.remove(subscriber)
            if caller not in self.subscribers:
                self._missed[caller] = (0, self._clock() + _MISSED_S)
                while len(self._missed) > _MAX_SUBSCRIBERS:
                    self._missed.pop(next(iter(self._missed)), None)
            self._is_anybody_back()
            subscriber.close()

    def heard(self, patience_s: float) -> Heard | None:
        """How far what was published with ``until`` has got; from one thread, any.

        Of those it is for: if they are not known, of all who listen; None: of those nobody does.
        """
        there = [one for one in list(self._subscribers) if not self._awaited or one.caller in self._awaited]
        unread = tuple(one.caller for one in there if one.see_read() > patience_s)
        return Heard(min(one.read_at for one in there), unread) if there else None

    def is_missed(self, wanted: Callable[[], Collection[str]]) -> bool:
        """Whether a node wants the topic still whose connection has ended, and does not connect by itself.

        A node of rospy does not, once a connection was reset. From one thread, any.

        Args:
            wanted: Names of the nodes that want it, as the master knows them; one that crashed is among them.
        """
        now = self._clock()
        due = [name for name, (_, at) in list(self._missed.items()) if at <= now]
        for name in due:
            tried, _ = self._missed.pop(name, (0, now))
            if name not in self.subscribers:
                self._missed[name] = (tried + 1, now + _MISSED_S * 2 ** min(tried + 1, _MOST_DOUBLED))
        left = [name for name in due if name in self._missed]
        known = wanted() if left else ()
        for name in left:
            if name not in known:
                self._missed.pop(name, None)
        return not set(left).isdisjoint(known)

    def _is_anybody_back(self) -> bool:
        there = {each: each.caller for each in self._subscribers}
        return self._comers.is_anybody_back(there, young=self._clock() - self._began < FINDS_S)

    def _refusal(self, caller: str, header: dict[str, str]) -> str:
        kind, md5 = header.get("type", ANY), header.get("md5sum", ANY)
        if len(self._subscribers) >= _MAX_SUBSCRIBERS:
            return f"{self._node}: {self.topic} has {_MAX_SUBSCRIBERS} subscribers already"
        if not sums_differ(self.md5, md5) and (kind in (ANY, self.type) or md5 not in (ANY, "")):
            return ""
        refusal = (
            f"{self.topic}: {caller} wants {kind} with MD5 {md5}, but it is {self.type} with MD5 {self.md5}; "
            "both sides need the same version of the message"
        )
        if (caller, md5) not in self._refused and len(self._refused) < _MAX_SUBSCRIBERS:
            self._refused.add((caller, md5))
            _log.error("%s", refusal)
        return refusal

    def close(self) -> None:
        """In the node's thread: let everybody go."""
        for subscriber in list(self._subscribers):
            subscriber.close()
