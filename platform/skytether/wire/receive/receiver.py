"""The receiving half of a session: packets -> authentic ones -> statistics, reassembly -> open -> whole messages.

Total: any bytes may come, at any time; what is refused counts under a bounded reason. Nothing but an authentic packet
that was not here before changes more than such a counter.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ..codec.ciphers import HandshakeTags
from ..codec.packet import (
    BLOCK,
    COMMON_SIZE,
    DATA,
    HEADER,
    HEADER_SIZE,
    HELLO,
    KEYS,
    PATH_AT,
    SHARD,
    SHARD_AT,
    VERSION,
    WELCOME,
    Packets,
    pull_packets,
)
from ..codec.plaintext import INNER, OVERHEAD, PREFIX
from ..codec.replay_window import ReplayVerdict
from ..config import Config
from ..connect.handshake import MAX_HANDSHAKE
from ..connect.handshake_driver import HandshakeMessage
from ..fec.reassembly import Entry, Reassembly
from ..path.path import Path
from ..state.epoch import CONTROL, Epoch

FAR_AHEAD = 65_536
"""An incomplete message whose number is further than this above the highest authentic one is refused."""
MIN_RUN = 3
"""Packets of one block in a batch from which handling them as an array is worth its fixed cost."""

HANDSHAKE_LIFESPAN = 1.0
"""Seconds for the shards of one handshake message to arrive."""


class AuthenticMessage(NamedTuple):
    """A message, the first time that it is complete."""

    epoch: Epoch
    """Under whose keys it came."""
    topic: int
    """Index of its topic; 0: it is a frame."""
    plaintext: bytes
    number: int
    path: int
    """By which it came, or its last packet."""
    address: Hashable
    now: float


class Origin(NamedTuple):
    """How packets came."""

    address: Hashable
    path: int | None
    """By which path; None: the headers say it."""
    now: float
    waited: float
    """Seconds for which this end did not get round to it."""


class Receiver:
    """Takes packets of one session on all its paths.

    Args:
        session_id: Id that HELLO must have; None: none is expected, but WELCOME, with any id.
        tags: Of the handshake packets that are expected.
        config: Bounds.
        find_path: Path by its id, or None.
        find_epoch: Epoch by the id of its packets, or None.
        on_expired: Called with the topic index of each message that stayed incomplete for too long.
        rejected: Counters of what is refused.
    """

    def __init__(
        self,
        session_id: int | None,
        tags: HandshakeTags,
        config: Config,
        find_path: Callable[[int], Path | None],
        find_epoch: Callable[[int], Epoch | None],
        on_expired: Callable[[int], None],
        rejected: Counter[str],
    ) -> None:
        self._session_id = session_id
        self._tags = tags
        self._max_length = config.max_message + PREFIX.size + OVERHEAD
        self._find_path = find_path
        self._find_epoch = find_epoch
        self.rejected = rejected
        self.messages = Reassembly(config.reassembly_limit, on_expired)
        self._handshakes = Reassembly(2 * MAX_HANDSHAKE, _nothing)

    @property
    def memory(self) -> int:
        """Bytes that incomplete messages take, of handshakes too."""
        return self.messages.used + self._handshakes.used

    def receive(
        self,
        data: memoryview,
        address: Hashable,
        path: int | None,
        now: float,
        segment: int | None,
        waited: float = 0.0,
    ) -> Iterable[AuthenticMessage | HandshakeMessage]:
        """Take a datagram, or a batch of datagrams of ``segment`` bytes (the last may be shorter).

        What is complete by it has to be drained, and each used before the next is asked for: it may bring the keys of
        the packets behind it.

        Args:
            data: The bytes.
            address: Where they came from.
            path: By which path they came; None: the headers say it.
            now: Time.
            segment: Size of the datagrams of a batch.
            waited: Seconds for which this end did not get round to it.

        Returns:
            What is complete, in the order of its packets.
        """
        origin = Origin(address, path, now, waited)
        if segment is not None and 0 < segment < len(data):
            return self._batch(data, segment, origin)
        complete = self._packet(data, origin)
        return () if complete is None else (complete,)

    def _batch(self, data: memoryview, segment: int, origin: Origin) -> Iterator[AuthenticMessage | HandshakeMessage]:
        """Several datagrams."""
        whole, total = len(data) // segment, len(data)
        run = self._shards(data, whole, segment, origin) if whole >= MIN_RUN else None
        if run is not None:
            yield from run
            start = whole * segment
        else:
            start = 0
        for begin in range(start, total, segment):
            complete = self._packet(data[begin : begin + segment], origin)
            if complete is not None:
                yield complete

    def sweep(self, now: float) -> None:
        """Drop incomplete messages that are too old."""
        self.messages.expire_all(now)
        self._handshakes.expire_all(now)

    def _shards(self, data: memoryview, whole: int, segment: int, origin: Origin) -> Iterable[AuthenticMessage] | None:
        """Packets of that size with shards under the same keys; None if they have to be looked at one by one."""
        if segment <= SHARD_AT:
            return None
        kind, packet_id, _ = KEYS.unpack_from(data)
        epoch = self._find_epoch(packet_id) if kind == SHARD else None
        if epoch is None:
            return None
        batch = pull_packets(data, whole, segment)
        paths = data[PATH_AT : whole * segment : segment].tobytes()
        block = batch["block"]
        change = np.flatnonzero(block[1:] != block[:-1]) + 1
        if paths.count(paths[0]) < whole or (len(change) and (batch["keys"][change] != batch["keys"][0]).any()):
            return None
        good = epoch.ciphers.check(data, whole, segment)
        if good is None:
            return None
        if not good.all():
            self.rejected["forged"] += whole - int(np.count_nonzero(good))
            batch = batch[good]
            if not len(batch):
                return ()
        by = paths[0]
        if origin.path not in (None, by):
            self.rejected["path"] += len(batch)
            return ()
        numbers = batch["number"].astype(np.uint32)
        new = epoch.packets(by).accept_all(numbers)
        if new is not None:
            self.rejected["repeated"] += len(batch) - int(np.count_nonzero(new))
            batch, numbers = batch[new], numbers[new]
            if not len(batch):
                return ()
        epoch.heard_at = origin.now
        epoch.bytes_received += len(batch) * segment
        known = self._find_path(by)
        if known is not None:
            known.comes(len(batch) * segment, len(batch), origin.now, origin.waited)
            known.arrived_all(numbers.tobytes(), batch["time"].astype(np.uint16).tobytes(), segment)
        if len(batch) < whole:
            block = batch["block"]
            change = np.flatnonzero(block[1:] != block[:-1]) + 1
        return self._runs(epoch, batch, change.tolist(), segment - SHARD_AT, by, origin)

    def _packet(self, data: memoryview, origin: Origin) -> AuthenticMessage | HandshakeMessage | None:
        """One packet."""
        size = len(data)
        if size <= HEADER_SIZE:
            self.rejected["short"] += 1
            return None
        kind, packet_id, _, high, low, topic, length, block, index, path, packet, time = HEADER.unpack_from(data)
        if kind not in (DATA, SHARD):
            return self._other(bytes(data), kind, packet_id, origin)
        epoch = self._find_epoch(packet_id)
        if epoch is None:
            self.rejected["session"] += 1
            return None
        plaintext: bytes | None = None
        if kind == DATA:
            plaintext = epoch.ciphers.open_packet(data)
        if plaintext is None and (kind == DATA or not epoch.ciphers.check_one(data)):
            self.rejected["forged"] += 1
            return None
        if origin.path not in (None, path):
            self.rejected["path"] += 1
            return None
        if not epoch.packets(path).accept(packet):
            self.rejected["repeated"] += 1
            return None
        epoch.heard_at = now = origin.now
        epoch.bytes_received += size
        known = self._find_path(path)
        if known is not None:
            known.comes(size, 1, now, origin.waited)
            known.arrived(packet, time, size)
        number = high << 32 | low
        if plaintext is not None:
            if self._refused(epoch, number, topic, 1, now):
                return None
            return self._open(epoch, number, topic, plaintext, path, origin)
        common = bytes(data[:COMMON_SIZE])
        entry = self._entry(epoch, number, topic, length, block, common, size - SHARD_AT, 1, now)
        sealed = self.messages.add(entry, block, index, data[SHARD_AT:]) if entry is not None else None
        if sealed is None:
            return None
        return self._open(epoch, number, topic, epoch.ciphers.open(number, sealed, common), path, origin)

    def _runs(
        self, epoch: Epoch, batch: Packets, changes: list[int], size: int, by: int, origin: Origin
    ) -> Iterator[AuthenticMessage]:
        """Packets with shards of that size, of another block from each of ``changes`` on."""
        for start, end in pairwise((0, *changes, len(batch))):
            complete = self._run(epoch, batch[start:end], size, by, origin)
            if complete is not None:
                yield complete

    def _run(self, epoch: Epoch, run: Packets, size: int, by: int, origin: Origin) -> AuthenticMessage | None:
        """Packets of one block of a large message, with shards of that size."""
        head = run["block"][0].tobytes()
        _, _, _, high, low, topic, length, block = BLOCK.unpack(head)
        number, common = high << 32 | low, head[:COMMON_SIZE]
        entry = self._entry(epoch, number, topic, length, block, common, size, len(run), origin.now)
        if entry is None:
            return None
        sealed = self.messages.add_all(entry, block, run["index"].copy(), run["shard"].copy())
        if sealed is None:
            return None
        return self._open(epoch, number, topic, epoch.ciphers.open(number, sealed, common), by, origin)

    def _entry(
        self,
        epoch: Epoch,
        number: int,
        topic: int,
        length: int,
        block: int,
        common: bytes,
        size: int,
        packets: int,
        now: float,
    ) -> Entry | None:
        """The incomplete message that packets of a large message claim to belong to; None (counted) if none can be."""
        if self._refused(epoch, number, topic, packets, now):
            return None
        if length > self._max_length:
            self.rejected["too_large"] += packets
            return None
        if number > epoch.replay.highest + FAR_AHEAD:
            self.rejected["implausible"] += packets
            return None
        lifespan = epoch.receive[topic].lifespan if topic else CONTROL.lifespan
        entry = self.messages.entry(common, size, length, topic, block, lifespan, now)
        if entry is None:
            self.rejected["shape"] += packets
        elif topic and (reliable := epoch.receive[topic].reliable_receiver) is not None:
            reliable.touch(now, entry)
        return entry

    def _refused(self, epoch: Epoch, number: int, topic: int, packets: int, now: float) -> bool:
        """Whether a message cannot be wanted: already accepted, too old, or of no topic."""
        receiver = epoch.receive.get(topic)
        if receiver is None and topic:
            self.rejected["topic"] += packets
            return True
        if number > epoch.replay.highest:  # as nearly always
            return False
        seen = epoch.replay.check(number)
        if seen is ReplayVerdict.NEW:
            return False
        if seen is ReplayVerdict.OLD:
            self.rejected["old"] += packets
        elif receiver is not None:
            receiver.counters.duplicate += packets
            if receiver.reliable_receiver is not None:  # the sender does not know that it arrived
                receiver.reliable_receiver.touch(now)
        return True

    def _open(
        self, epoch: Epoch, number: int, topic: int, plaintext: bytes | None, by: int, origin: Origin
    ) -> AuthenticMessage | None:
        """A complete message, if it was not here before; ``plaintext`` None: not what was sealed."""
        if plaintext is None or len(plaintext) < INNER.size:
            self.rejected["forged"] += 1
            return None
        if not epoch.replay.accept(number):
            return None
        return AuthenticMessage(epoch, topic, plaintext, number, by, origin.address, origin.now)

    def _other(self, data: bytes, kind: int, packet_id: int, origin: Origin) -> HandshakeMessage | None:
        """A packet that is not of an established session's messages: a handshake, or nothing of ours."""
        hello = self._session_id is not None
        if kind >> 4 != VERSION:
            self.rejected["version"] += 1
        elif kind not in (HELLO, WELCOME):
            self.rejected["type"] += 1
        elif (kind == HELLO) is not hello:
            self.rejected["unasked"] += 1
        elif hello and packet_id != self._session_id:
            self.rejected["session"] += 1
        elif not self._tags.check(data):
            self.rejected["hello_forged" if hello else "welcome_forged"] += 1
        else:
            return self._shake(data, kind, origin)
        return None

    def _shake(self, data: bytes, kind: int, origin: Origin) -> HandshakeMessage | None:
        """An authentic packet of a handshake; the message that it completes."""
        *_, length, block, index, path, _, _ = HEADER.unpack_from(data)
        size, now, common = len(data) - SHARD_AT, origin.now, data[:COMMON_SIZE]
        by = path if origin.path is None else origin.path
        if not size <= length <= MAX_HANDSHAKE:
            self.rejected["shape"] += 1
            return None
        if length == size:
            return HandshakeMessage(kind, common, data[SHARD_AT:], by, origin.address, now)
        entry = self._handshakes.entry(common, size, length, 0, block, HANDSHAKE_LIFESPAN, now)
        if entry is None:
            self.rejected["shape"] += 1
            return None
        message = self._handshakes.add(entry, block, index, memoryview(data)[SHARD_AT:])
        if message is None:
            return None
        return HandshakeMessage(kind, common, bytes(message), by, origin.address, now)


def _nothing(_topic: int) -> None:
    """Nobody counts handshake messages that stay incomplete."""
