"""What a handshake gave: the keys of both directions, and what they do to messages and packets."""

from __future__ import annotations

import hmac

import numpy as np

from . import crypto
from .packet import HEADER_SIZE, NONCE_AT, SHARD_AT, TAG_SIZE, TIME_AT
from .tags import SECRET_SIZE, Bools, Rows, Tagger, Tags, Words

_PAD = bytes(12 - (TIME_AT - NONCE_AT))
_NUMBER_SIZE = 12


class _Direction:
    """Keys of what one end sends."""

    __slots__ = ("message", "packet", "tags")

    def __init__(self, secret: bytes) -> None:
        keys = crypto.derive(secret, b"", b"direction", 2 * crypto.KEY_SIZE + SECRET_SIZE)
        self.message = crypto.Aead(keys[: crypto.KEY_SIZE])
        self.packet = crypto.Aead(keys[crypto.KEY_SIZE : 2 * crypto.KEY_SIZE])
        self.tags = Tags(keys[2 * crypto.KEY_SIZE :])


class Ciphers:
    """What one handshake gave: keys to seal with, keys to open with, and public names.

    Args:
        seal_secret: Of the direction in which this end sends.
        open_secret: Of the other.
        resume: Tells the peer which keys this end still holds without telling anything of the keys.
        packet_id: Id in the packets of both directions.
    """

    __slots__ = ("_in", "_out", "packet_id", "resume", "tagger")

    def __init__(self, seal_secret: bytes, open_secret: bytes, resume: bytes, packet_id: int) -> None:
        self._out, self._in = _Direction(seal_secret), _Direction(open_secret)
        self.resume = resume
        self.packet_id = packet_id
        self.tagger: Tagger = self._out.tags

    def seal_into(self, number: int, plaintext: bytes, common: bytes, out: memoryview) -> None:
        """Seal a message of several packets; ``number`` must never have been used with these keys.

        ``out`` takes ``len(plaintext) + crypto.TAG_SIZE`` bytes.
        """
        self._out.message.seal_into(number.to_bytes(_NUMBER_SIZE, "big"), plaintext, common, out)

    def open(self, number: int, sealed: memoryview | bytes, common: memoryview | bytes) -> bytes | None:
        """Plaintext of such a message, or None if it is not authentic."""
        return self._in.message.open(number.to_bytes(_NUMBER_SIZE, "big"), sealed, common)

    def seal_packet(self, header: bytes, plaintext: bytes) -> bytes:
        """A whole message as one packet; path and packet number in the header must never have been used before."""
        return header + self._out.packet.seal(_PAD + header[NONCE_AT:TIME_AT], plaintext, header)

    def open_packet(self, data: memoryview | bytes) -> bytes | None:
        """Plaintext of such a packet, or None if it is not authentic."""
        nonce = _PAD + bytes(data[NONCE_AT:TIME_AT])
        return self._in.packet.open(nonce, data[HEADER_SIZE:], data[:HEADER_SIZE])

    def check(self, data: memoryview, count: int, size: int) -> Bools | None:
        """Which of so many equal packets with shards are authentic; None: no shard has that size."""
        if size <= SHARD_AT or size % 4:
            return None
        return self._in.tags.check(np.frombuffer(data, np.uint8, count * size).reshape(count, size))

    def check_one(self, data: memoryview | bytes) -> bool:
        """The same for one."""
        size = len(data)
        return size > SHARD_AT and not size % 4 and self._in.tags.check_one(data)


class HandshakeTags:
    """Tags of handshake packets, under a key derived from the session key: nonces would have to be remembered.

    Args:
        key: Session key.
        label: Of the direction.
    """

    __slots__ = ("_key",)

    def __init__(self, key: bytes, label: bytes) -> None:
        self._key = crypto.derive(key, b"", b"tags of " + label)

    def sums(self, _heads: Rows, _shards: Rows) -> None:
        """Nothing is known before."""

    def put(self, rows: Rows, _sums: Words | None = None) -> None:
        """Write the tags of packets in their place."""
        for row in rows:
            row[HEADER_SIZE:SHARD_AT] = np.frombuffer(self._tag(row.tobytes()), np.uint8)

    def check(self, data: bytes) -> bool:
        """Whether a packet has the right tag."""
        return len(data) > SHARD_AT and hmac.compare_digest(self._tag(data), data[HEADER_SIZE:SHARD_AT])

    def _tag(self, data: bytes) -> bytes:
        return crypto.short_mac(self._key, data[:HEADER_SIZE] + data[SHARD_AT:], TAG_SIZE)
