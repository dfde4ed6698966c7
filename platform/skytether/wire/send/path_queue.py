"""What goes out on one path: sealed messages, copies that are due later, packets of large messages."""

from __future__ import annotations

import heapq
import math
from bisect import insort_left
from collections import deque
from collections.abc import Hashable

from ..codec.packet import HEADER_SIZE, SHARD_AT
from ..fec.fragment import Shards
from ..path.path import Path, Transmit
from ..reliable.reliable_sender import ReliableSender
from ..reliable.selective_repeat import SelectiveRepeat
from ..state.epoch import SendTopic
from .message import LoneShard, Message
from .queue import SendQueue

MAX_SEGMENTS = 64
"""Datagrams in one UDP_SEGMENT batch that every kernel takes."""
MAX_URGENT = 16
"""Pings that may wait for the socket: they tell nothing when they are late."""
MAX_TAKEN = 4096
"""Small messages of another path that may wait; a path that is too slow for them misses the rest."""
MAX_IN_FLIGHT = 64
"""Large ones; the lowest priorities give way."""
RECENT_TIME = 1.0
"""Seconds for which sent messages are kept in case that their path turns out to be broken."""
RECENT_BYTES = 2**20
"""Most memory for them."""


class Copy:
    """A message of one packet that is sent again; or one shard of a larger one that is sent later."""

    __slots__ = ("content", "deadline", "due", "left", "spacing", "topic")

    def __init__(
        self,
        topic: SendTopic,
        content: Message | LoneShard,
        left: int,
        spacing: float,
        due: float,
        deadline: float,
    ) -> None:
        self.topic = topic
        self.content = content
        self.left = left
        self.spacing = spacing
        self.due = due
        self.deadline = deadline

    def __lt__(self, other: Copy) -> bool:
        return self.due < other.due

    @property
    def size(self) -> int:
        """Bytes that it holds."""
        return self.content.size


class InFlight:
    """A large message of which some packets are still to be sent."""

    __slots__ = ("deadline", "sent_at", "shards", "topic")

    def __init__(self, topic: SendTopic, shards: Shards, deadline: float) -> None:
        self.topic = topic
        self.shards = shards
        self.deadline = deadline
        self.sent_at = -math.inf
        """When its latest packet was sent."""

    @property
    def size(self) -> int:
        """Bytes that it holds."""
        return self.shards.length


class Batches:
    """Collects packets into as few Transmits as possible, in order: equal sizes together, a shorter one ends a run."""

    __slots__ = ("_address", "_path", "_run", "_size", "done")

    def __init__(self, path: int, address: Hashable) -> None:
        self._path = path
        self._address = address
        self._run: list[bytes] = []
        self._size = 0
        self.done: list[Transmit] = []

    def add(self, packet: bytes) -> None:
        """One more packet."""
        run, size = self._run, len(packet)
        if run and (size > self._size or len(run) == MAX_SEGMENTS):
            self.flush()
        if not self._run:
            self._size = size
        self._run.append(packet)
        if size < self._size:
            self.flush()

    def add_run(self, packets: memoryview, size: int) -> None:
        """Several packets of that size."""
        self.flush()
        segment = size if len(packets) > size else None
        self.done.append(Transmit(self._path, self._address, packets, segment))

    def flush(self) -> None:
        """Finish the batch under way."""
        run = self._run
        if run:
            data = run[0] if len(run) == 1 else b"".join(run)
            self.done.append(Transmit(self._path, self._address, data, self._size if len(run) > 1 else None))
            self._run = []


class PathQueue:
    """State of sending on one path."""

    __slots__ = ("_recent", "_recent_bytes", "copies", "in_flight", "path", "queue", "urgent", "wake")

    def __init__(self, path: Path, queue_limit: int) -> None:
        self.path = path
        self.queue: SendQueue[Copy | ReliableSender] = SendQueue(queue_limit)
        """Copies that are due, and of the active path the messages that are not sealed yet."""
        self.in_flight: list[InFlight] = []
        """Rising priority: the last is sent first."""
        self.copies: list[Copy] = []
        """Heap by due time."""
        self.urgent: list[bytes] = []
        """Packets that wait for nothing."""
        self.wake = math.inf
        self._recent: deque[tuple[float, Copy | InFlight]] = deque()
        self._recent_bytes = 0

    @property
    def room(self) -> int:
        """Largest sealed message of one packet."""
        return self.path.mtu.size - HEADER_SIZE

    @property
    def shard_room(self) -> int:
        """Largest shard."""
        return self.path.mtu.size - SHARD_AT

    def clear(self) -> None:
        """Drop everything."""
        self.queue.clear()
        for waiting in (self.in_flight, self.copies, self.urgent, self._recent):
            waiting.clear()
        self._recent_bytes = 0
        self.wake = math.inf

    def next_timer(self) -> float:
        """When there will be something to send; 0 for at once, inf for never."""
        if self.urgent or (self.wake == math.inf and self.queue.priority >= 0):
            return 0.0
        return min(self.copies[0].due, self.wake) if self.copies else self.wake

    def add_urgent(self, packet: bytes) -> None:
        """Send a packet before everything else."""
        if len(self.urgent) < MAX_URGENT:
            self.urgent.append(packet)

    def queue_due(self, now: float) -> None:
        """Queue the copies whose time has come."""
        while self.copies and self.copies[0].due <= now:
            copy = heapq.heappop(self.copies)
            self.queue.put_other(copy.topic.priority, copy)

    def enqueue(self, message: Copy | InFlight, now: float, times: int = 1) -> None:
        """Send a message that another path has as well; a small one that many times."""
        topic, deadline = message.topic, message.deadline
        if isinstance(message, InFlight):
            shards = message.shards.again(self.shard_room)
        elif message.size > self.room and isinstance(message.content, Message):
            shards = message.content.shards(self.shard_room)
        else:
            if len(self.queue) < MAX_TAKEN:
                copy = Copy(topic, message.content, times, message.spacing, now, deadline)
                self.queue.put_other(topic.priority, copy)
            return
        insort_left(self.in_flight, InFlight(topic, shards, deadline), key=_priority)
        del self.in_flight[:-MAX_IN_FLIGHT]
        self.wake = now

    def land_reliable(self, now: float) -> None:
        """This path is not the active one any more: what is reliable goes on by another, as its timers say."""
        reliable = [f.shards for f in self.in_flight if isinstance(f.shards, SelectiveRepeat)]
        self.in_flight = [f for f in self.in_flight if not isinstance(f.shards, SelectiveRepeat)]
        for shards in reliable:
            shards.land(now)

    def remember(self, message: Copy | InFlight, now: float) -> None:
        """Keep a message that was sent just now."""
        recent = self._recent
        recent.append((now, message))
        self._recent_bytes += message.size
        while recent[0][0] < now - RECENT_TIME or (self._recent_bytes > RECENT_BYTES and len(recent) > 1):
            self._recent_bytes -= recent.popleft()[1].size

    def repeat(self, other: PathQueue, since: float, now: float) -> None:
        """Have another path (or this one, which leads elsewhere now) send what may not have arrived by this one.

        Args:
            other: Of the path.
            since: What was sent from then on may not have arrived; what is too old is left out.
            now: Time.
        """
        for sent_at, message in self._recent:
            if isinstance(message, InFlight):
                sent_at = now if message.shards.remaining else message.sent_at
            if sent_at >= since and message.deadline >= now:
                other.enqueue(message, now)
        self._recent.clear()
        self._recent_bytes = 0


def _priority(message: InFlight) -> int:
    return message.topic.priority
