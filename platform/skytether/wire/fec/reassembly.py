"""Shards back into sealed messages, within a bound of memory, whatever arrives.

Shards are the peer's, but the peer may be hostile. So a message is kept by all that its shards say of it (a shard with
another topic, length or size makes an entry of its own), memory is counted by what arrived (a shard that claims 16 MiB
reserves nothing), and when memory runs out, the topic that uses the most of it loses its oldest entry.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable

import numpy as np

from .fragment import MAX_SHARDS, Shape
from .reed_solomon import Bytes, recover

ENTRY_COST = 1024
"""Bytes of book-keeping charged for an incomplete message, on top of its shards."""
BLOCK_COST = 1536
"""The same for a block of it."""
SHARD_COST = 128
"""The same for a shard."""

Key = tuple[bytes, int]
"""Common part of the header, shard size."""


class _Block:
    __slots__ = ("count", "data", "k", "rows", "seen", "singles")

    def __init__(self, k: int) -> None:
        self.k = k
        self.count = 0
        self.seen = bytearray(MAX_SHARDS)
        self.rows: list[tuple[Bytes, Bytes]] = []
        """Indices and shards that came in batches."""
        self.singles: dict[int, bytes] = {}
        """Shards that came alone, by index."""
        self.data: Bytes | None = None
        """All data shards, once there are enough shards; it takes no more then."""

    def add(self, index: int, shard: memoryview | bytes) -> int:
        """Returns how many shards were new."""
        if self.seen[index] or self.data is not None:
            return 0
        self.seen[index] = 1
        self.singles[index] = bytes(shard)
        self.count += 1
        return 1

    def add_all(self, indices: Bytes, shards: Bytes) -> int:
        if self.data is not None:
            return 0
        seen = np.frombuffer(self.seen, np.uint8)
        if seen[indices].any() or not (indices[1:] > indices[:-1]).all():  # repeated or reordered: one by one
            return sum(self.add(int(index), shard.tobytes()) for index, shard in zip(indices, shards, strict=True))
        seen[indices] = 1
        self.rows.append((indices, shards))
        self.count += len(indices)
        return len(indices)

    def finish(self, size: int) -> None:
        """Make the data shards from what there is, at least k shards."""
        out = self.data = np.empty((self.k, size), np.uint8)
        rows = self.rows
        if self.singles:
            shards = np.frombuffer(b"".join(self.singles.values()), np.uint8).reshape(len(self.singles), -1)
            rows = [*rows, (np.fromiter(self.singles, np.uint8, len(self.singles)), shards)]
        k = self.k
        parity: dict[int, Bytes] = {}
        for indices, shards in rows:
            data = indices < k
            if data.all():
                out[indices] = shards
            else:
                out[indices[data]] = shards[data]
                parity.update(zip(indices[~data].tolist(), shards[~data], strict=True))
        missing = [i for i in range(k) if not self.seen[i]]
        if missing:
            recover(out, missing, parity)
        self.rows, self.singles = [], {}


class Entry:
    """One incomplete message."""

    __slots__ = ("alive", "blocks", "cost", "deadline", "key", "missing", "shape", "topic")

    def __init__(self, key: Key, shape: Shape, topic: int, deadline: float) -> None:
        self.key = key
        self.shape = shape
        self.topic = topic
        self.deadline = deadline
        self.blocks: dict[int, _Block] = {}
        self.missing = shape.blocks
        """Blocks that cannot be decoded yet."""
        self.cost = 0
        self.alive = True

    def gaps(self, limit: int) -> tuple[int, list[tuple[int, bytes]]]:
        """Data shards that are missing, up to the highest block of which something arrived.

        Returns:
            Block at which this account ends, and at most ``limit`` incomplete blocks before it with one bit for each
            data shard, set for a missing one.
        """
        rows: list[tuple[int, bytes]] = []
        end = max(self.blocks, default=-1) + 1
        for number in range(end):
            block = self.blocks.get(number)
            if block is not None and block.data is not None:
                continue
            if len(rows) == limit:
                return number, rows
            k = self.shape.block_k(number)
            seen = np.zeros(k, np.uint8) if block is None else np.frombuffer(block.seen, np.uint8, k)
            rows.append((number, np.packbits(seen == 0, bitorder="little").tobytes()))
        return end, rows

    def assemble(self) -> memoryview:
        """The sealed message."""
        parts = [block.data for _, block in sorted(self.blocks.items()) if block.data is not None]
        whole = parts[0] if len(parts) == 1 else np.concatenate(parts)
        return whole.reshape(-1).data[: self.shape.length]


class Reassembly:
    """Incomplete messages of one session.

    Args:
        limit: Most memory used, bytes. A complete message that is being opened comes on top.
        on_expired: Called with the topic index of each message that got too old.
    """

    def __init__(self, limit: int, on_expired: Callable[[int], None]) -> None:
        self._limit = limit
        self._on_expired = on_expired
        self._entries: dict[Key, Entry] = {}
        self._topics: dict[int, OrderedDict[Key, Entry]] = {}
        """By topic, oldest first."""
        self._costs: dict[int, int] = {}
        self.used = 0
        """Bytes in use; never above the limit."""
        self.evicted = 0
        """Messages dropped because memory ran out."""

    def __len__(self) -> int:
        return len(self._entries)

    def entry(
        self, common: bytes, size: int, length: int, topic: int, block: int, lifespan: float, now: float
    ) -> Entry | None:
        """The message that a shard claims to belong to.

        Args:
            common: Common part of the shard's header.
            size: Size of the shard.
            length: Sealed length by the header.
            topic: Topic index by the header.
            block: Block by the header.
            lifespan: Seconds before the message is dropped if it stays incomplete.
            now: Time of arrival.

        Returns:
            None if no message can have such a shard.
        """
        self.expire(topic, now)
        key = common, size
        entry = self._entries.get(key)
        if entry is None:
            shape = Shape(length, size) if 0 < size < length else None
            if shape is None or not shape.valid or block >= shape.blocks:
                return None
            entry = self._entries[key] = Entry(key, shape, topic, now + lifespan)
            self._topics.setdefault(topic, OrderedDict())[key] = entry
            self._charge(entry, ENTRY_COST)
        return entry if block < entry.shape.blocks else None

    def add(self, entry: Entry, block: int, index: int, shard: memoryview) -> memoryview | None:
        """Take one shard; returns the sealed message if it is complete now (it is then forgotten here)."""
        target = self._block(entry, block)
        before = target.count
        return self._added(entry, target, before, target.add(index, shard))

    def add_all(self, entry: Entry, block: int, indices: Bytes, shards: Bytes) -> memoryview | None:
        """The same for several shards of one block, as rows; keeps both arrays."""
        target = self._block(entry, block)
        before = target.count
        return self._added(entry, target, before, target.add_all(indices, shards))

    def expire(self, topic: int, now: float) -> None:
        """Drop a topic's messages that are too old."""
        entries = self._topics.get(topic)
        while entries:
            entry = next(iter(entries.values()))
            if entry.deadline > now:
                return
            self._forget(entry)
            self._on_expired(topic)

    def expire_all(self, now: float) -> None:
        """Drop everything that is too old."""
        for topic in list(self._topics):
            self.expire(topic, now)

    def _block(self, entry: Entry, number: int) -> _Block:
        block = entry.blocks.get(number)
        if block is None:
            block = entry.blocks[number] = _Block(entry.shape.block_k(number))
            self._charge(entry, BLOCK_COST)
        return block

    def _added(self, entry: Entry, block: _Block, before: int, new: int) -> memoryview | None:
        if before < block.k <= block.count:
            # Block by block, so that the last shard of a large message does not have to wait for all of them.
            block.finish(entry.shape.size)
            entry.missing -= 1
            if entry.missing == 0:
                self._forget(entry)
                return entry.assemble()
        self._charge(entry, new * (entry.shape.size + SHARD_COST))
        return None

    def _charge(self, entry: Entry, cost: int) -> None:
        if not entry.alive:  # made room for itself
            return
        entry.cost += cost
        self._costs[entry.topic] = self._costs.get(entry.topic, 0) + cost
        self.used += cost
        while self.used > self._limit:
            most = max(self._costs, key=self._costs.__getitem__)
            self._forget(next(iter(self._topics[most].values())))
            self.evicted += 1

    def _forget(self, entry: Entry) -> None:
        entry.alive = False
        del self._entries[entry.key]
        entries = self._topics[entry.topic]
        del entries[entry.key]
        self.used -= entry.cost
        self._costs[entry.topic] -= entry.cost
        if not entries:
            del self._topics[entry.topic], self._costs[entry.topic]
