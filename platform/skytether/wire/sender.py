"""The sending half of a session: queue -> seal -> shards -> paced batches.

A message is sealed when it leaves the queue; what was replaced or expired before has no sequence number. Large
messages that are on their way form a stack: a higher priority interrupts a lower one after its burst.
"""

from __future__ import annotations

import heapq
import math
import struct
from collections.abc import Hashable

from .config import Config
from .crypto import TAG_SIZE
from .epoch import CONTROL_PRIORITY, Epoch, SendTopic
from .fragment import Shards, shape_for
from .packet import DATA, HEADER_SIZE, push_common, push_shard
from .path import Path, Transmit
from .queue import SendQueue
from .redundancy import RedundancyPolicy

INNER = struct.Struct(">IQ")
"""Start of the plaintext: topic sequence, time of publishing in microseconds of the sender's clock."""
OVERHEAD = INNER.size + TAG_SIZE
MAX_SEGMENTS = 64
"""Datagrams in one UDP_SEGMENT batch that every kernel takes."""
MAX_BATCH = 65_507
"""Bytes of such a batch: it is one IP packet to the kernel until it is cut."""


class _Copy:
    """A sealed one-shard message that is sent again."""

    __slots__ = ("common", "deadline", "due", "left", "sealed", "topic")

    def __init__(self, topic: SendTopic, common: bytes, sealed: bytes, left: int, due: float, deadline: float) -> None:
        self.topic = topic
        self.common = common
        self.sealed = sealed
        self.left = left
        self.due = due
        self.deadline = deadline

    def __lt__(self, other: _Copy) -> bool:
        return self.due < other.due


class _Flight:
    """A large message of which some packets are still to be sent."""

    __slots__ = ("deadline", "shards", "topic")

    def __init__(self, topic: SendTopic, shards: Shards, deadline: float) -> None:
        self.topic = topic
        self.shards = shards
        self.deadline = deadline


class _Batches:
    """Collects packets into as few Transmits as possible, in order: equal sizes together, a shorter one ends a run."""

    __slots__ = ("_address", "_path", "_run", "_size", "done")

    def __init__(self, path: int, address: Hashable) -> None:
        self._path = path
        self._address = address
        self._run: list[bytes] = []
        self._size = 0
        self.done: list[Transmit] = []

    def add(self, packet: bytes) -> None:
        run, size = self._run, len(packet)
        if run and (size > self._size or len(run) == MAX_SEGMENTS):
            self.flush()
        if not self._run:
            self._size = size
        self._run.append(packet)
        if size < self._size:
            self.flush()

    def add_run(self, packets: memoryview, size: int) -> None:
        self.flush()
        segment = size if len(packets) > size else None
        self.done.append(Transmit(self._path, self._address, packets, segment))

    def flush(self) -> None:
        run = self._run
        if run:
            data = run[0] if len(run) == 1 else b"".join(run)
            self.done.append(Transmit(self._path, self._address, data, self._size if len(run) > 1 else None))
            self._run = []


class Sender:
    """Sends on one path. Several paths (rule 8) will share the queue."""

    def __init__(self, session_id: int, config: Config, redundancy: RedundancyPolicy) -> None:
        self._session_id = session_id
        self._config = config
        self._redundancy = redundancy
        self._room = config.mtu - HEADER_SIZE
        self.queue: SendQueue[_Copy] = SendQueue(config.queue_limit)
        self.epoch: Epoch | None = None
        self._flights: list[_Flight] = []
        """Rising priority: the last is sent first."""
        self._copies: list[_Copy] = []
        """Heap by due time."""
        self._wake = math.inf

    def start_epoch(self, epoch: Epoch | None) -> None:
        """Use other keys from now on; what was queued or under way for the old ones is dropped."""
        self.queue.clear()
        self._flights.clear()
        self._copies.clear()
        self._wake = math.inf
        self.epoch = epoch

    def put(self, topic: SendTopic, payload: bytes, published_at: float, extra: int | None = None) -> None:
        """Queue a message; ``extra`` packets, or as many as the redundancy policy says."""
        self.queue.put(topic, payload, published_at, extra)

    def next_timer(self) -> float:
        """When `transmit` will have something to send; 0 for at once, inf for never."""
        if self._wake == math.inf and self.queue.priority >= 0:
            return 0.0
        return min(self._copies[0].due, self._wake) if self._copies else self._wake

    def transmit(self, path: Path, now: float) -> list[Transmit]:
        """What may be sent now, at most a burst."""
        epoch, address = self.epoch, path.address
        if epoch is None or address is None:
            return []
        queue, flights, copies = self.queue, self._flights, self._copies
        while copies and copies[0].due <= now:
            copy = heapq.heappop(copies)
            queue.put_other(copy.topic.priority, copy)
        pacer = path.pacer
        left = min(pacer.budget(now), self._config.burst)
        batches = _Batches(path.id, address)
        self._wake = math.inf
        while (priority := queue.priority) >= 0 or flights:
            if flights and flights[-1].topic.priority >= priority:
                flight = flights[-1]
                shards = flight.shards
                if flight.deadline < now:
                    flights.pop()
                    flight.topic.counters.expired += 1
                    continue
                size = shards.packet_size
                need = min(shards.remaining * size, max(size, pacer.quantum // size * size))
                if left < need:
                    self._wake = pacer.ready_at(need)
                    break
                count = min(shards.remaining, int(left // size), MAX_SEGMENTS, MAX_BATCH // size)
                batches.add_run(shards.take(count, path.id, path.number(count)), size)
                sent = count * size
                flight.topic.counters.bytes_sent += sent
                if not shards.remaining:
                    flights.pop()
            elif left <= 0 and priority < CONTROL_PRIORITY:
                self._wake = pacer.ready_at(1)
                break
            else:
                item = queue.pop(now)
                if isinstance(item, _Copy):
                    sent = self._send_copy(item, path, batches, now)
                elif item is not None:
                    sent = self._send_first(epoch, *item, path, batches, now)
                else:
                    continue
            left -= sent
            path.bytes_sent += sent
            pacer.spend(sent)
        batches.flush()
        return batches.done

    def _send_first(
        self,
        epoch: Epoch,
        topic: SendTopic,
        payload: bytes,
        published_at: float,
        extra: int | None,
        path: Path,
        batches: _Batches,
        now: float,
    ) -> int:
        """Seal a message; send it if it is one shard, else put it on top of the flights. Returns bytes sent."""
        length = len(payload) + OVERHEAD
        number = epoch.next_number
        epoch.next_number = number + 1
        plaintext = INNER.pack(topic.sequence, int(published_at * 1e6)) + payload
        topic.sequence = (topic.sequence + 1) & 0xFFFFFFFF
        counters = topic.counters
        counters.sent += 1
        counters.payload_sent += len(payload)
        common = push_common(DATA, self._session_id, epoch.id, number, topic.index, length)
        if length <= self._room:
            sealed = epoch.ciphers.seal(number, plaintext, common)
            if extra is None:
                extra = self._redundancy(1, 1, topic.delivery)
            if extra:
                due = now + self._config.copy_spacing
                copy = _Copy(topic, common, sealed, extra, due, published_at + topic.lifespan)
                heapq.heappush(self._copies, copy)
            return self._send_shard(topic, common, sealed, path, batches)
        shape = shape_for(length, self._room)
        sealed_shards = memoryview(bytearray(shape.shards * shape.size))
        epoch.ciphers.seal_into(number, plaintext, common, sealed_shards[:length])
        parity = self._redundancy(shape.block_k(0), shape.blocks, topic.delivery)
        self._flights.append(_Flight(topic, Shards(common, sealed_shards, shape, parity), now + topic.lifespan))
        return 0

    def _send_copy(self, copy: _Copy, path: Path, batches: _Batches, now: float) -> int:
        if copy.deadline < now:
            return 0
        copy.left -= 1
        if copy.left:
            copy.due = now + self._config.copy_spacing
            heapq.heappush(self._copies, copy)
        return self._send_shard(copy.topic, copy.common, copy.sealed, path, batches)

    @staticmethod
    def _send_shard(topic: SendTopic, common: bytes, sealed: bytes, path: Path, batches: _Batches) -> int:
        packet = b"".join((common, push_shard(0, 0, path.id, path.number()), sealed))
        topic.counters.bytes_sent += len(packet)
        batches.add(packet)
        return len(packet)
