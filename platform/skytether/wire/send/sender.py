"""The sending half of a session: queue -> seal -> shards -> paced batches.

A message is sealed when it leaves the queue; what was replaced or expired before has no sequence number. Large
messages that are on their way form a stack: a higher priority interrupts a lower one after its burst. The active path
empties the queue; what it has sealed may go by another one too (rule 8).
"""

from __future__ import annotations

import heapq
import math
from collections import deque
from collections.abc import Callable, Container, Hashable, Iterable
from functools import partial

from ..codec.compression import original_size
from ..codec.packet import SHARD_AT, ticks
from ..codec.plaintext import push_inner
from ..config import Config
from ..fec.fragment import Shards, encode_sealed
from ..fec.redundancy import Copies
from ..measure.counters import Outbound
from ..path.path import Path, Transmit
from ..reliable.reliable_sender import NUMBER_SPAN, ReliableSender
from ..reliable.selective_repeat import SelectiveRepeat
from ..state.epoch import CONTROL, CONTROL_PRIORITY, Epoch, SendTopic
from .message import LoneShard, Message
from .path_queue import MAX_SEGMENTS, Batches, Copy, InFlight, PathQueue
from .queue import SendQueue

NO_WAVES = Copies(0, 0.0)
MAX_ASTRAY = 16
"""Packets to unproven addresses that may wait for the socket."""
MAX_BATCH = 65_507
"""Bytes of such a batch: it is one IP packet to the kernel until it is cut."""


class Sender:
    """Sends on the paths that `use` names.

    Args:
        config: Settings.
        path: The only one at first.
    """

    def __init__(self, config: Config, path: Path) -> None:
        self._config = config
        self.epoch: Epoch | None = None
        self._control = _control()
        self._path_queues = {path.id: PathQueue(path, config.queue_limit)}
        self._active = self._path_queues[path.id]
        self._other: PathQueue | None = None
        self._doubled = False
        self.astray: deque[Transmit] = deque()
        """Packets to other addresses than those of their paths."""

    @property
    def queue(self) -> SendQueue[Copy | ReliableSender]:
        """Messages that are not sealed yet."""
        return self._active.queue

    def use(self, paths: Iterable[Path], active: Path, other: Path | None, doubled: bool, now: float) -> None:
        """Send on these from now on.

        Args:
            paths: All there are; what waits for any other is dropped.
            active: By which messages go.
            other: By which copies go, and topics that ask for two paths; None if there is none.
            doubled: Whether everything goes by both.
            now: Time.
        """
        before, already = self._active, self._doubled
        self._path_queues = {p.id: self._path_queue(p) for p in paths}
        self._active = self._path_queues[active.id]
        self._other = self._path_queues[other.id] if other is not None else None
        self._doubled = doubled
        if self._active is not before:
            before.queue, self._active.queue = self._active.queue, before.queue
            before.land_reliable(now)
            if not already:
                before.repeat(self._active, before.path.liveness.confirmed_at, now)
        elif self._other is not None and doubled and not already:
            before.repeat(self._other, before.path.liveness.confirmed_at, now)

    def start_epoch(self, epoch: Epoch | None) -> None:
        """Use other keys from now on; what was queued or under way for the old ones is dropped."""
        for path_queue in self._path_queues.values():
            path_queue.clear()
        self.astray.clear()
        self.epoch = epoch
        self._control = _control()

    def change_keys(self, epoch: Epoch) -> None:
        """Seal with other keys from now on; what was sealed before is sent as it is."""
        self.epoch = epoch

    def queue_message(self, topic: SendTopic, payload: bytes, published_at: float, extra: int | None = None) -> None:
        """Queue a message; ``extra`` packets, or as many as the redundancy policy says."""
        self._active.queue.put(topic, payload, published_at, extra)

    def queue_reliable(self, reliable: ReliableSender) -> None:
        """Queue a reliable topic that has something to send."""
        reliable.queued = True
        self._active.queue.put_other(reliable.topic.priority, reliable)

    def queue_frame(self, message: bytes, now: float) -> None:
        """Queue a frame, once: the next one of its kind makes up for its loss."""
        self.queue_message(self._control, message, now, extra=0)

    def send_frame(self, path: Path, message: bytes, now: float) -> None:
        """Send a frame of one packet by that path, once and at once, however large the packet."""
        packet = self._packet(message, path, path.number, now)
        if packet is not None:
            self._path_queue(path).add_urgent(packet)

    def send_frame_to(self, address: Hashable, path: Path, message: bytes, now: float) -> int:
        """The same to some address, which need not be the path's; returns its bytes, 0 if it cannot be sent."""
        number = partial(path.number_astray, now)
        packet = self._packet(message, path, number, now) if len(self.astray) < MAX_ASTRAY else None
        if packet is None:
            return 0
        path.bytes_sent += len(packet)
        self.astray.append(Transmit(path.id, address, packet, None))
        return len(packet)

    def repeat(self, path: Path, since: float, now: float) -> None:
        """The peer moved: send again what went where it was not any more, of topics that ask for every effort."""
        path_queue = self._path_queue(path)
        path_queue.repeat(path_queue, since, now)

    def _packet(self, message: bytes, path: Path, number: Callable[[], int], now: float) -> bytes | None:
        """Seal a frame of one packet, which gets that number; None if there are no keys."""
        epoch, topic = self.epoch, self._control
        if epoch is None or epoch.spent:
            return None
        packet = self._next(epoch, topic, message, now).packet(path.id, number(), ticks(now))
        topic.counters.bytes_sent += len(packet)
        return packet

    def _path_queue(self, path: Path) -> PathQueue:
        path_queue = self._path_queues.get(path.id)
        if path_queue is None or path_queue.path is not path:
            path_queue = self._path_queues[path.id] = PathQueue(path, self._config.queue_limit)
        return path_queue

    def next_timer(self, full: Container[int] = ()) -> float:
        """When `transmit` will have something to send by paths not ``full``; 0 for at once, inf for never."""
        due = math.inf
        if self.epoch is not None and self.epoch.spent:
            return due
        for path_queue in self._path_queues.values():
            path = path_queue.path
            if path.address is not None and path.id not in full:
                due = min(due, path_queue.next_timer())
        return due

    def transmit(self, path: Path, now: float) -> list[Transmit]:
        """What may be sent now, at most a burst."""
        epoch, address = self.epoch, path.address
        if epoch is None or address is None or epoch.spent:
            return []
        path_queue = self._path_queue(path)
        queue, in_flight, pacer = path_queue.queue, path_queue.in_flight, path.pacer
        path_queue.wake = math.inf
        if path_queue.copies:
            path_queue.queue_due(now)
        if not (queue or in_flight or path_queue.urgent):
            return []
        left = min(pacer.budget(now), self._config.burst)
        batches = Batches(path.id, address)
        if path_queue.urgent:
            left -= self._send_urgent(epoch, path_queue, batches)
        while (priority := queue.priority) >= 0 or in_flight:
            if in_flight and in_flight[-1].topic.priority >= priority:
                sent = self._send_shards(path_queue, batches, left, now)
                if sent is None:
                    break
            elif left <= 0 and priority < CONTROL_PRIORITY:
                path_queue.wake = pacer.ready_at(1)
                break
            else:
                sent = self._send_queued(epoch, path_queue, batches, now)
            left -= sent
            path.bytes_sent += sent
            epoch.bytes_sent += sent
            pacer.spend(sent)
        batches.flush()
        return batches.done

    @staticmethod
    def _send_urgent(epoch: Epoch, path_queue: PathQueue, batches: Batches) -> int:
        """Send what waits for nothing. Returns bytes sent."""
        sent = 0
        for packet in path_queue.urgent:
            batches.add(packet)
            sent += len(packet)
        path_queue.urgent.clear()
        path_queue.path.bytes_sent += sent
        epoch.bytes_sent += sent
        path_queue.path.pacer.spend(sent)
        return sent

    @staticmethod
    def _send_shards(path_queue: PathQueue, batches: Batches, left: float, now: float) -> int | None:
        """Send some of the large message that comes first. Returns bytes sent; None: it waits for the pacer."""
        path, top = path_queue.path, path_queue.in_flight[-1]
        shards, counters, pacer = top.shards, top.topic.counters, path.pacer
        if top.deadline < now:
            path_queue.in_flight.pop()
            counters.expired += 1
            return 0
        size, sent = shards.packet_size, 0
        if shards.remaining:  # else delivered or given up meanwhile
            need = min(shards.remaining * size, max(size, pacer.quantum // size * size))
            if left < need:
                path_queue.wake = pacer.ready_at(need)
                return None
            path.large = True
            top.sent_at = now
            count = min(shards.remaining, int(left // size), MAX_SEGMENTS, MAX_BATCH // size)
            counters.bytes_redundant += min(max(count - shards.remaining_data, 0), count) * size
            batches.add_run(shards.make_packets(count, path.id, path.number(count), ticks(now)), size)
            shards.sent(count, now)
            sent = count * size
            counters.bytes_sent += sent
        if not shards.remaining:
            path_queue.in_flight.pop()
            shards.land(now)
        return sent

    def _send_queued(self, epoch: Epoch, path_queue: PathQueue, batches: Batches, now: float) -> int:
        """Send the next of the queue. Returns bytes sent."""
        item = path_queue.queue.pop(now)
        if isinstance(item, Copy):
            return self._send_copy(item, path_queue, batches, now)
        if isinstance(item, ReliableSender):
            return self._send_reliable(epoch, item, path_queue, batches, now)
        if item is not None:
            return self._send_first(epoch, *item, path_queue, batches, now)
        return 0

    def _send_first(
        self,
        epoch: Epoch,
        topic: SendTopic,
        payload: bytes,
        published_at: float,
        extra: int | None,
        path_queue: PathQueue,
        batches: Batches,
        now: float,
    ) -> int:
        """Seal a message; send it if it is one shard, else put it on top of those in flight. Returns bytes sent."""
        message = self._next(epoch, topic, payload, published_at)
        if message.size <= path_queue.room:
            return self._send_small(topic, message, published_at + topic.lifespan, extra, path_queue, batches, now)
        common, sealed, shape = message.seal(path_queue.shard_room)
        tagger = message.ciphers.tagger
        redundancy, k, deadline = path_queue.path.redundancy, shape.block_k(0), now + topic.lifespan
        waves = redundancy.waves(k, topic.delivery, topic.lifespan) if shape.blocks == 1 else NO_WAVES
        parity = 0 if waves.more else redundancy.parity(k, shape.blocks, topic.delivery)
        rows = range(k, k + k * waves.more)
        for row, shard in zip(rows, encode_sealed(sealed, shape, rows), strict=True):
            due = now + (row // k) * waves.spacing
            lone = LoneShard(common, row, shard, tagger)
            heapq.heappush(path_queue.copies, Copy(topic, lone, 1, waves.spacing, due, deadline))
        sending = InFlight(topic, Shards(common, sealed, shape, parity, tagger), deadline)
        path_queue.in_flight.append(sending)
        if self._other is not None or topic.redundant:
            path_queue.remember(sending, now)
        if self._other is not None and (self._doubled or topic.redundant):
            self._other.enqueue(sending, now)
        return 0

    def _send_reliable(
        self, epoch: Epoch, reliable: ReliableSender, path_queue: PathQueue, batches: Batches, now: float
    ) -> int:
        """The next of a reliable topic: seal it, or go on with the shards of a large one. Returns bytes sent."""
        reliable.queued = False
        pending, topic = reliable.next(now), epoch.send.get(reliable.topic.name)
        if reliable.ready:
            self.queue_reliable(reliable)
        if pending is None or topic is None:
            return 0
        shards = pending.shards
        if shards is not None and (
            shards.number + NUMBER_SPAN < epoch.next_number
            or shards.packet_size > path_queue.shard_room + SHARD_AT
            or (shards.tagger is not epoch.ciphers.tagger and not shards.sending)
        ):
            shards.cancel()
            shards = pending.shards = None
        if shards is None:
            plaintext = push_inner(pending.sequence, pending.published_at, pending.payload)
            plaintext += reliable.prefix(pending) + pending.payload
            message = self._number(epoch, topic, plaintext)
            if message.size <= path_queue.room:
                reliable.sent(pending, now)
                return self._send_small(topic, message, pending.deadline, None, path_queue, batches, now)
            landed = partial(reliable.landed, pending)
            sealed = message.seal(path_queue.shard_room)
            shards = pending.shards = SelectiveRepeat(message.number, *sealed, message.ciphers.tagger, landed)
        if not shards.sending:
            shards.sending = True
            path_queue.in_flight.append(InFlight(topic, shards, math.inf))
        return 0

    def _next(self, epoch: Epoch, topic: SendTopic, payload: bytes, published_at: float) -> Message:
        """A topic's next message."""
        plaintext = push_inner(topic.sequence, published_at, payload) + payload
        topic.sequence = (topic.sequence + 1) & 0xFFFFFFFF
        counters = topic.counters
        counters.sent += 1
        counters.payload_sent += original_size(payload)
        return self._number(epoch, topic, plaintext)

    @staticmethod
    def _number(epoch: Epoch, topic: SendTopic, plaintext: bytes) -> Message:
        """Give a plaintext its message number."""
        number = epoch.next_number
        epoch.next_number = number + 1
        return Message(epoch.ciphers, epoch.id, number, topic.index, plaintext)

    def _send_small(
        self,
        topic: SendTopic,
        message: Message,
        deadline: float,
        extra: int | None,
        path_queue: PathQueue,
        batches: Batches,
        now: float,
    ) -> int:
        """Send a message of one packet, and plan its copies. Returns bytes sent."""
        other = self._other
        planned, spacing = path_queue.path.redundancy.copies(topic.delivery, topic.lifespan)
        extra = planned if extra is None else extra
        if other is not None or topic.redundant:
            sent = Copy(topic, message, 0, spacing, 0.0, deadline)
            path_queue.remember(sent, now)
            # every second copy goes by the other path, one at once
            if other is not None and (self._doubled or topic.redundant or (extra and message.size <= other.room)):
                there = max(1, (extra + 1) // 2)
                other.enqueue(sent, now, there)
                extra = max(0, extra - there)
        if extra:
            heapq.heappush(path_queue.copies, Copy(topic, message, extra, spacing, now + spacing, deadline))
        return self._send_packet(topic, message, path_queue.path, batches, now)

    def _send_copy(self, copy: Copy, path_queue: PathQueue, batches: Batches, now: float) -> int:
        if copy.deadline < now:
            return 0
        copy.left -= 1
        if copy.left:
            copy.due = now + copy.spacing
            heapq.heappush(path_queue.copies, copy)
        size = self._send_packet(copy.topic, copy.content, path_queue.path, batches, now)
        copy.topic.counters.bytes_redundant += size
        return size

    @staticmethod
    def _send_packet(topic: SendTopic, content: Message | LoneShard, path: Path, batches: Batches, now: float) -> int:
        packet = content.packet(path.id, path.number(), ticks(now))
        topic.counters.bytes_sent += len(packet)
        batches.add(packet)
        return len(packet)


def _control() -> SendTopic:
    """What an epoch's frames are sent as; nobody reads their counters."""
    return SendTopic(0, CONTROL, Outbound(), CONTROL_PRIORITY)
