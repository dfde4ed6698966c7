"""A sealed message as equal shards in blocks, with parity: what the sender cuts and the receiver reassembles.

A message of ``length`` bytes in shards of ``size`` bytes (a multiple of 4, for the tags) has ``ceil(length / size)``
data shards, in as few blocks of at most `BLOCK_SHARDS` as will do, split evenly. The receiver derives all of it from
two numbers. Parity is that of `reed_solomon`.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt

from ..codec.packet import COMMON_SIZE, HEADER_SIZE, INDEX_AT, NUMBER_AT, SHARD_AT, TIME_AT
from ..codec.tags import Tagger, Words
from .reed_solomon import Bytes, encode

Positions = npt.NDArray[np.intp]
"""Of data shards in their message."""
AHEAD = 64
"""Shards hashed at a time: many at once cost less each, and nothing waits long for them."""


BLOCK_SHARDS = 100
"""Data shards of a block: the cost of coding grows with k times m, and one block may have 256 shards in all."""
MAX_SHARDS = 256
"""Shards of a block with parity: what GF(256) allows."""
STEP = 4
MIN_SHARD = 236
"""A message of several shards has none smaller than this: half of what fits the smallest mtu."""
MAX_BLOCKS = 65_535


class Shape:
    """How a message of several shards is laid out."""

    __slots__ = ("blocks", "extra", "k", "length", "shards", "size")

    def __init__(self, length: int, size: int) -> None:
        self.length = length
        self.size = size
        self.shards = -(-length // size)
        """Data shards of the whole message."""
        self.blocks = -(-self.shards // BLOCK_SHARDS)
        self.k, self.extra = divmod(self.shards, self.blocks)
        """Data shards of a block; the first ``extra`` blocks have one more."""

    @property
    def valid(self) -> bool:
        """Whether a sender of this protocol may cut a message like this."""
        return self.size % STEP == 0 and self.shards > 1 and self.size >= MIN_SHARD and self.blocks <= MAX_BLOCKS

    def block_k(self, block: int) -> int:
        """Data shards of one block."""
        return self.k + (block < self.extra)

    def block_start(self, block: int) -> int:
        """Position in the message of a block's first shard."""
        return block * self.k + min(block, self.extra)


def shape_for(length: int, room: int) -> Shape:
    """Fewest equal shards that hold ``length`` bytes with at most ``room`` bytes each."""
    shards = -(-length // (room // STEP * STEP))
    return Shape(length, -(-length // (shards * STEP)) * STEP)


def encode_sealed(sealed: memoryview, shape: Shape, rows: range) -> list[bytes]:
    """Parity shards of a sealed message of one block, padded to whole shards: ``rows`` are their indices."""
    if not rows:
        return []
    return encode(np.frombuffer(sealed, np.uint8).reshape(shape.shards, shape.size), rows)


@lru_cache(maxsize=256)
def _order(count: int, parity: int) -> Bytes:
    """Order of sending, as the packets' own parts of the header: block, index, zeros.

    Data goes first, in order. Parity follows, one shard of each block in turn, so that a run of losses hits
    different blocks.
    """
    shape = Shape(count, 1)
    sizes = np.array([shape.block_k(b) for b in range(shape.blocks)])
    block = np.concatenate([np.repeat(np.arange(shape.blocks), sizes), np.tile(np.arange(shape.blocks), parity)])
    within = [np.arange(k) for k in sizes]
    index = np.concatenate([*within, *(sizes + j for j in range(parity))])
    tails = np.zeros((len(block), HEADER_SIZE - COMMON_SIZE), np.uint8)
    tails[:, 0], tails[:, 1], tails[:, 2] = block >> 8, block & 255, index
    return tails


class Shards:
    """One sealed message on its way out. Packets are made as they are sent, parity when it is needed."""

    __slots__ = (
        "_common", "_data", "_parity", "_sent", "_shape", "_summed", "_sums", "_tails", "length", "packet_size",
        "remaining", "tagger",
    )  # fmt: skip

    def __init__(self, common: bytes, sealed: memoryview, shape: Shape, parity: int, tagger: Tagger) -> None:
        """Take a sealed message.

        Args:
            common: The header's common part.
            sealed: ``shape.shards * shape.size`` bytes, zeros after ``shape.length``.
            shape: Its layout, with more than one shard.
            parity: Parity shards of each block.
            tagger: Of the keys that the common part names.
        """
        self._common = np.frombuffer(common, np.uint8)
        self._data: Bytes = np.frombuffer(sealed, np.uint8).reshape(shape.shards, shape.size)
        self._shape = shape
        self.tagger = tagger
        self._tails = _order(shape.shards, parity)
        self._parity: dict[tuple[int, int], bytes] = {}
        self._sent = 0
        self._sums: Words | None = None
        """Of data shards."""
        self._summed = 0
        """Of how many."""
        self.length = shape.length
        self.packet_size = SHARD_AT + shape.size
        self.remaining = len(self._tails)
        """Packets not yet taken."""

    @property
    def remaining_data(self) -> int:
        """Data shards not yet taken."""
        return max(self._shape.shards - self._sent, 0)

    def make_packets(self, count: int, path: int, first_number: int, time: int) -> memoryview:
        """The next ``count`` packets, one after the other, each of ``packet_size`` bytes; ``time`` in ticks."""
        start, end, shards = self._sent, self._sent + count, self._shape.shards
        rows = self._headers(self._tails[start:end], path, first_number, time)
        data_end = min(end, shards)
        if start < data_end:
            rows[: data_end - start, SHARD_AT:] = self._data[start:data_end]
        if end > shards:
            first = max(start, shards)
            parity = b"".join([self._parity_shard(i) for i in range(first, end)])
            rows[first - start :, SHARD_AT:] = np.frombuffer(parity, np.uint8).reshape(end - first, -1)
        self._sent = end
        self.remaining -= count
        self.tagger.put(rows, self._sums_of(start, end) if end <= shards else None)
        return rows.reshape(-1).data

    def sent(self, count: int, now: float) -> None:
        """The last ``count`` packets taken were sent now."""

    def land(self, now: float) -> None:
        """Nothing is left to be taken."""

    def again(self, room: int) -> Shards:
        """All of the message once more, in shards of at most ``room`` bytes: of the same size if they fit."""
        shape = self._shape if self._shape.size <= room else shape_for(self._shape.length, room)
        parity = (len(self._tails) - self._shape.shards) // self._shape.blocks
        return shards_of(
            self._common.tobytes(), self._data.reshape(-1).data[: shape.length], shape, parity, self.tagger
        )

    def pick(self, positions: Positions, path: int, first_number: int, time: int) -> memoryview:
        """Packets of any data shards, by their positions in the message, as `make_packets` returns them."""
        rows = self._headers(self._tails[positions], path, first_number, time)
        rows[:, SHARD_AT:] = self._data[positions]
        sums = self._sums_of(0, int(positions.max()) + 1)
        self.tagger.put(rows, None if sums is None else sums[positions])
        return rows.reshape(-1).data

    def _sums_of(self, start: int, end: int) -> Words | None:
        """Of these data shards."""
        first = self._summed
        if end > first:
            self._summed = last = min(max(end, first + AHEAD), self._shape.shards)
            heads = np.empty((last - first, INDEX_AT), np.uint8)
            heads[:, :COMMON_SIZE] = self._common
            heads[:, COMMON_SIZE:] = self._tails[first:last, : INDEX_AT - COMMON_SIZE]
            sums = self.tagger.sums(heads, self._data[first:last])
            if sums is None:
                return None
            if self._sums is None:
                self._sums = np.empty((self._shape.shards, 2), np.uint64)
            self._sums[first:last] = sums
        return None if self._sums is None else self._sums[start:end]

    def _headers(self, tails: Bytes, path: int, first_number: int, time: int) -> Bytes:
        """Rows for packets, without tags and shards."""
        count = len(tails)
        rows = np.empty((count, self.packet_size), np.uint8)
        rows[:, :COMMON_SIZE] = self._common
        rows[:, COMMON_SIZE:HEADER_SIZE] = tails
        rows[:, NUMBER_AT - 1] = path
        numbers = np.arange(first_number, first_number + count).astype(">u4")
        rows[:, NUMBER_AT:TIME_AT] = numbers.view(np.uint8).reshape(count, 4)
        rows[:, TIME_AT], rows[:, TIME_AT + 1] = time >> 8, time & 255
        return rows

    def _parity_shard(self, position: int) -> bytes:
        blocks, parity = self._shape.blocks, (len(self._tails) - self._shape.shards) // self._shape.blocks
        turn, block = divmod(position - self._shape.shards, blocks)
        k, start = self._shape.block_k(block), self._shape.block_start(block)
        if (block, turn) not in self._parity:
            # All of a single block at once; of many blocks only what is sent now, so that no call takes long.
            turns = range(parity) if blocks == 1 else range(turn, turn + 1)
            made = encode(self._data[start : start + k], [k + t for t in turns])
            self._parity.update(zip(((block, t) for t in turns), made, strict=True))
        return self._parity.pop((block, turn))


def shards_of(common: bytes, sealed: memoryview | bytes, shape: Shape, parity: int, tagger: Tagger) -> Shards:
    """A sealed message in that layout."""
    padded = memoryview(bytearray(shape.shards * shape.size))
    padded[: shape.length] = sealed
    return Shards(common, padded, shape, parity, tagger)
