"""The receiving half of a session: packets -> reassembly -> open -> quality of service -> events.

Total: any bytes may come, at any time; what is refused counts under a bounded reason. Nothing but an authentic,
complete message changes more than a counter or a bounded buffer.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable
from itertools import pairwise

import numpy as np

from .config import Config
from .epoch import CONTROL, Epoch
from .handshake import MAX_HANDSHAKE
from .packet import (
    BLOCK,
    COMMON_SIZE,
    DATA,
    HEADER,
    HEADER_SIZE,
    HELLO,
    KEYS,
    PATH_AT,
    VERSION,
    WELCOME,
    Packets,
    peek_session_id,
    pull_packets,
)
from .path import Path
from .reassembly import Entry, Reassembly
from .reliable import PREFIX
from .replay import Seen
from .sender import INNER, OVERHEAD

FAR_AHEAD = 65_536
"""An incomplete message whose number is further than this above the highest authentic one is refused."""
MIN_RUN = 3
"""Packets of one block in a batch from which handling them as an array is worth its fixed cost."""

HANDSHAKE_LIFESPAN = 1.0
"""Seconds for the shards of one handshake message to arrive."""

Accept = Callable[[Epoch, int, bytes, int, int, Hashable, float], None]
"""Epoch, topic index, plaintext, message number, path, address, time of arrival."""
TakeHandshake = Callable[[int, bytes, bytes, int, Hashable, float], None]
"""Type, common part of the header, message, path, address, time of arrival."""


class Receiver:
    """Takes packets of one session on all its paths.

    Args:
        session_id: Of the session.
        config: Bounds.
        find_path: Path by its id, or None.
        find_epoch: Epoch by its id, or None.
        accept: Called with each authentic message, once.
        handshake: Called with each complete, not yet authenticated handshake message.
        on_expired: Called with the topic index of each message that stayed incomplete for too long.
        rejected: Counters of what is refused.
    """

    def __init__(
        self,
        session_id: int,
        config: Config,
        find_path: Callable[[int], Path | None],
        find_epoch: Callable[[int], Epoch | None],
        accept: Accept,
        handshake: TakeHandshake,
        on_expired: Callable[[int], None],
        rejected: Counter[str],
    ) -> None:
        self._session_id = session_id
        self._max_length = config.max_message + PREFIX.size + OVERHEAD
        self._find_path = find_path
        self._find_epoch = find_epoch
        self._accept = accept
        self._handshake = handshake
        self.rejected = rejected
        self.messages = Reassembly(config.reassembly_limit, on_expired)
        self._handshakes = Reassembly(2 * MAX_HANDSHAKE, _nothing)

    def receive(
        self,
        data: memoryview,
        address: Hashable,
        path: int | None,
        now: float,
        segment: int | None,
        waited: float = 0.0,
    ) -> None:
        """Take a datagram, or a batch of datagrams of ``segment`` bytes (the last may be shorter).

        Args:
            data: The bytes.
            address: Where they came from.
            path: By which path they came; None: the headers say it, and all of a batch came by the same.
            now: Time.
            segment: Size of the datagrams of a batch.
            waited: Seconds for which this end did not get round to it.
        """
        total = len(data)
        by = path if path is not None else data[PATH_AT] if total > PATH_AT else 0
        known = self._find_path(by)
        several = segment is not None and 0 < segment < total
        if known is not None and peek_session_id(data) == self._session_id:
            known.comes(total, -(-total // segment) if several and segment else 1, now, waited)
        if not several or segment is None:
            self._packet(data, address, by, known, now)
            return
        whole = total // segment
        batch = self._batch(data, whole, segment, by)
        if batch is None:
            for start in range(0, total, segment):
                self._packet(data[start : start + segment], address, by, known, now)
            return
        if known is not None:
            numbers, times = batch["number"].astype(np.uint32), batch["time"].astype(np.uint16)
            known.arrived_all(numbers.tobytes(), times.tobytes(), segment)
        block = batch["block"]
        change = np.flatnonzero(block[1:] != block[:-1]) + 1
        for start, end in pairwise((0, *change.tolist(), whole)):
            if end - start < MIN_RUN or not self._run(batch[start:end], address, by, now):
                for i in range(start, end):
                    self._packet(data[i * segment : (i + 1) * segment], address, by, None, now)
        if total > whole * segment:
            self._packet(data[whole * segment :], address, by, known, now)

    def sweep(self, now: float) -> None:
        """Drop incomplete messages that are too old."""
        self.messages.expire_all(now)
        self._handshakes.expire_all(now)

    def _batch(self, data: memoryview, whole: int, segment: int, by: int) -> Packets | None:
        """A batch's packets of that size, if all are of this session's messages under the same keys by one path."""
        if whole < MIN_RUN or segment <= HEADER_SIZE:
            return None
        kind, session_id, epoch_id = KEYS.unpack_from(data)
        if kind != DATA or session_id != self._session_id or self._find_epoch(epoch_id) is None:
            return None
        batch = pull_packets(data, whole, segment)
        keys = batch["keys"]
        return None if (keys != keys[0]).any() or (batch["path"] != by).any() else batch

    def _packet(self, data: memoryview, address: Hashable, by: int, path: Path | None, now: float) -> None:
        """One packet; ``path`` is None if there is none or it knows of the packet already."""
        size = len(data) - HEADER_SIZE
        if size <= 0:
            self.rejected["short"] += 1
            return
        kind, session_id, epoch_id, high, low, topic, length, block, index, path_id, packet, time = HEADER.unpack_from(
            data
        )
        if kind != DATA or session_id != self._session_id:
            self._other(data, kind, session_id, size, length, block, index, by, address, now)
            return
        epoch = self._find_epoch(epoch_id)
        if epoch is None:
            self.rejected["epoch"] += 1
            return
        if path_id != by:
            self.rejected["path"] += 1
            return
        if path is not None:
            path.arrived(packet, time, len(data))
        number = high << 32 | low
        if length != size:
            entry = self._entry(epoch, number, topic, length, block, bytes(data[:COMMON_SIZE]), size, 1, now)
            if entry is not None:
                sealed = self.messages.add(entry, block, index, data[HEADER_SIZE:])
                if sealed is not None:
                    self._open(epoch, number, topic, sealed, entry.key[0], by, address, now)
        elif not self._refused(epoch, number, topic, 1, now):
            if block or index:
                self.rejected["shape"] += 1
            else:
                self._open(epoch, number, topic, data[HEADER_SIZE:], data[:COMMON_SIZE], by, address, now)

    def _run(self, run: Packets, address: Hashable, by: int, now: float) -> bool:
        """Several packets of one block of a large message; False if they have to be looked at one by one."""
        head = run["block"][0].tobytes()
        _, _, epoch_id, high, low, topic, length, block = BLOCK.unpack(head)
        epoch = self._find_epoch(epoch_id)
        size = run["shard"].shape[1]
        if epoch is None or length == size:
            return False
        number, common = high << 32 | low, head[:COMMON_SIZE]
        entry = self._entry(epoch, number, topic, length, block, common, size, len(run), now)
        if entry is not None:
            sealed = self.messages.add_all(entry, block, run["index"].copy(), run["shard"].copy())
            if sealed is not None:
                self._open(epoch, number, topic, sealed, common, by, address, now)
        return True

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
        elif topic and (inbox := epoch.receive[topic].inbox) is not None:
            inbox.touch(now, entry)
        return entry

    def _refused(self, epoch: Epoch, number: int, topic: int, packets: int, now: float) -> bool:
        """Whether a message cannot be wanted: already accepted, too old, or of no topic."""
        receiver = epoch.receive.get(topic)
        if receiver is None and topic:
            self.rejected["topic"] += packets
            return True
        seen = epoch.replay.check(number)
        if seen is Seen.NEW:
            return False
        if seen is Seen.OLD:
            self.rejected["old"] += packets
        elif receiver is not None:
            receiver.counters.duplicate += packets
            if receiver.inbox is not None:  # the sender does not know that it arrived
                receiver.inbox.touch(now)
        return True

    def _open(
        self,
        epoch: Epoch,
        number: int,
        topic: int,
        sealed: memoryview,
        common: memoryview | bytes,
        by: int,
        address: Hashable,
        now: float,
    ) -> None:
        plaintext = epoch.ciphers.open(number, sealed, common)
        if plaintext is None or len(plaintext) < INNER.size:
            self.rejected["forged"] += 1
            return
        if epoch.replay.accept(number):
            self._accept(epoch, topic, plaintext, number, by, address, now)

    def _other(
        self,
        data: memoryview,
        kind: int,
        session_id: int,
        size: int,
        length: int,
        block: int,
        index: int,
        by: int,
        address: Hashable,
        now: float,
    ) -> None:
        """A packet that is not of an established session's messages: a handshake, or nothing of ours."""
        if kind >> 4 != VERSION:
            self.rejected["version"] += 1
        elif session_id != self._session_id:
            self.rejected["session"] += 1
        elif kind not in (HELLO, WELCOME):
            self.rejected["type"] += 1
        elif not size <= length <= MAX_HANDSHAKE:
            self.rejected["shape"] += 1
        else:
            common = bytes(data[:COMMON_SIZE])
            if length == size:
                self._handshake(kind, common, bytes(data[HEADER_SIZE:]), by, address, now)
                return
            entry = self._handshakes.entry(common, size, length, 0, block, HANDSHAKE_LIFESPAN, now)
            if entry is None:
                self.rejected["shape"] += 1
                return
            message = self._handshakes.add(entry, block, index, data[HEADER_SIZE:])
            if message is not None:
                self._handshake(kind, common, bytes(message), by, address, now)


def _nothing(_topic: int) -> None:
    """Nobody counts handshake messages that stay incomplete."""
