"""Messages that have a number, and the packets that they become.

A message that fits one packet is sealed with each packet anew, so that one cipher call protects both. A larger one is
sealed once and cut into shards, each of which has a tag.
"""

from __future__ import annotations

import numpy as np

from ..codec.ciphers import Ciphers
from ..codec.crypto import TAG_SIZE
from ..codec.packet import DATA, SHARD, push_common, push_shard
from ..codec.packet import TAG_SIZE as SHARD_TAG_SIZE
from ..codec.tags import Tagger
from ..fec.fragment import Shape, Shards, shape_for


class Message:
    """One message under one handshake's keys.

    Args:
        ciphers: The keys.
        epoch: Their id.
        number: Never used with them before.
        topic: Index of its topic.
        plaintext: All of it.
    """

    __slots__ = ("_epoch", "_topic", "ciphers", "number", "plaintext", "size")

    def __init__(self, ciphers: Ciphers, epoch: int, number: int, topic: int, plaintext: bytes) -> None:
        self.ciphers = ciphers
        self._epoch = epoch
        self._topic = topic
        self.number = number
        self.plaintext = plaintext
        self.size = len(plaintext) + TAG_SIZE
        """Bytes when sealed."""

    def common(self, kind: int) -> bytes:
        """Common part of the header of its packets of that type."""
        return push_common(kind, self.ciphers.packet_id, self._epoch, self.number, self._topic, self.size)

    def packet(self, path: int, number: int, time: int) -> bytes:
        """All of it as one packet with that number, which is never used twice; ``time`` in ticks."""
        return self.ciphers.seal_packet(self.common(DATA) + push_shard(0, 0, path, number, time), self.plaintext)

    def seal(self, room: int) -> tuple[bytes, memoryview, Shape]:
        """Common part of the header, padded bytes and layout as shards of at most ``room`` bytes."""
        common, shape = self.common(SHARD), shape_for(self.size, room)
        sealed = memoryview(bytearray(shape.shards * shape.size))
        self.ciphers.seal_into(self.number, self.plaintext, common, sealed[: self.size])
        return common, sealed, shape

    def shards(self, room: int) -> Shards:
        """The same as packets to be made, without parity."""
        return Shards(*self.seal(room), 0, self.ciphers.tagger)


class LoneShard:
    """One shard of a sealed message that is sent by itself."""

    __slots__ = ("_common", "_index", "_shard", "_tagger", "size")

    def __init__(self, common: bytes, index: int, shard: bytes, tagger: Tagger) -> None:
        self._common = common
        self._index = index
        self._shard = shard
        self._tagger = tagger
        self.size = len(shard)

    def packet(self, path: int, number: int, time: int) -> bytes:
        """As `Message.packet`."""
        header = self._common + push_shard(0, self._index, path, number, time)
        data = bytearray(header + bytes(SHARD_TAG_SIZE) + self._shard)
        self._tagger.put(np.frombuffer(data, np.uint8).reshape(1, -1))
        return bytes(data)
