"""Tags: 8 bytes that tell a packet of the peer from one that somebody made up, for a whole batch at once.

A tag is AES-256 over a 16-byte block of a universal hash of the packet (8 bytes) and its nonce (8 bytes of the header:
shard, path, packet number, time), cut to 8 bytes: WMAC (Black and Cochran, FSE 2009). The hash is multilinear over
32-bit words with 64-bit keys, twice, of which the upper halves count (Lemire and Kaser, 2014): two different packets
collide with a chance of 2^-64, whatever they are. Each try to forge succeeds with a chance below 2^-62, also after
others did, because tags reveal nothing of the hash's keys. Packet numbers do not repeat under one key, but were one to
repeat, nothing would be lost but that bound: there is no nonce whose repetition gives a key away.

In Python a call of a cipher or hash costs more than its arithmetic: tags one by one (GMAC, BLAKE2) take four times as
long as a batch of them by NumPy.
"""

from __future__ import annotations

import hmac
import struct

import numpy as np
import numpy.typing as npt

from .crypto import KEY_SIZE, block_cipher, key_stream
from .packet import HEADER_SIZE, TAG_SIZE

Rows = npt.NDArray[np.uint8]
"""Packets of the same size, a multiple of 4."""
Bools = npt.NDArray[np.bool_]
Words = npt.NDArray[np.uint64]

NONCE_WORDS = slice(6, 8)
"""Bytes 24 to 32 of the header, as words."""
TAG_WORDS = slice(HEADER_SIZE // 4, (HEADER_SIZE + TAG_SIZE) // 4)
SECRET_SIZE = 2 * KEY_SIZE
_WORD = np.dtype("<u4")
_FIRST = 352
"""Words for which there are keys from the beginning: a packet of 1,400 bytes."""
_CHUNK = 64 * _FIRST
"""Words handled at a time: as a rule a whole batch, and no more memory for large packets that somebody makes up."""
_SIZES = 256
"""Sizes of packets remembered: more than are in use."""
_NONCE_AND_TAG = struct.Struct("4s4s8s")
_BLOCK = struct.Struct("<4sI4sI")
_MASK = 2**64 - 1
_Sized = tuple[Words, Words, tuple[int, ...]]
"""Keys and constant for packets of one size, the constant also as plain numbers."""


class Tags:
    """Makes and checks the tags of one direction under one handshake's keys.

    Args:
        secret: `SECRET_SIZE` bytes.
    """

    __slots__ = ("_blocks", "_constant", "_keys", "_scratch", "_secret", "_sized")

    def __init__(self, secret: bytes) -> None:
        self._secret = secret[:KEY_SIZE]
        self._blocks = block_cipher(secret[KEY_SIZE:])
        self._scratch = np.empty(0, np.uint64)
        """Memory for words, always the same: new pages cost more than the arithmetic."""
        self._extend(_FIRST)

    def put(self, rows: Rows) -> None:
        """Write the tags of packets in their place."""
        words = rows.view("<u4")
        words[:, TAG_WORDS] = np.frombuffer(self._blocks(self._hashes(words)), "<u4").reshape(-1, 4)[:, :2]

    def check(self, rows: Rows) -> Bools:
        """Which of these packets have the right tag. Takes the same time whichever bytes are wrong."""
        given = rows[:, HEADER_SIZE : HEADER_SIZE + TAG_SIZE].view("<u8")[:, 0]
        right: Bools = np.frombuffer(self._blocks(self._hashes(rows.view("<u4"))), "<u8")[::2] == given
        return right

    def check_one(self, data: memoryview | bytes) -> bool:
        """The same for one packet."""
        words = np.frombuffer(data, _WORD)
        keys, _, constant = self._sized.get(len(words)) or self._prepare(len(words))
        first, second = keys.dot(words).tolist()
        upper = (first + constant[0] & _MASK) >> 32, (second + constant[1] & _MASK) >> 32
        nonce, rest, tag = _NONCE_AND_TAG.unpack_from(data, 4 * NONCE_WORDS.start)
        block = _BLOCK.pack(nonce, upper[0], rest, upper[1])
        return hmac.compare_digest(self._blocks(block)[:TAG_SIZE], tag)

    def _hashes(self, words: npt.NDArray[np.uint32]) -> bytes:
        """Of each packet a block: hash and nonce, four bytes in turn."""
        count, size = words.shape
        keys, constant, _ = self._sized.get(size) or self._prepare(size)
        hashes = np.empty((count, 2), np.uint64)
        step = len(self._scratch) // size
        for start in range(0, count, step):
            rows = words[start : start + step]
            wide = self._scratch[: rows.size].reshape(rows.shape)
            wide[...] = rows
            np.einsum("ij,kj->ik", wide, keys, out=hashes[start : start + step])
        hashes += constant
        hashes.view("<u4")[:, ::2] = words[:, NONCE_WORDS]  # the lower halves do not count
        return hashes.tobytes()

    def _prepare(self, size: int) -> _Sized:
        """Keys for packets of so many words, which also depend on the size itself."""
        if size > self._keys.shape[1]:
            self._extend(size)
        elif len(self._sized) == _SIZES:
            self._sized.clear()
        constant = self._constant[0] + self._constant[1] * np.uint64(size)
        made = self._sized[size] = self._keys[:, :size], constant, tuple(constant.tolist())
        return made

    def _extend(self, size: int) -> None:
        stream = np.frombuffer(key_stream(self._secret, 16 * (size + 2)), "<u8").astype(np.uint64).reshape(-1, 2)
        self._constant, self._keys = stream[:2], np.ascontiguousarray(stream[2:].T)
        self._keys[:, TAG_WORDS] = 0  # a packet's own tag does not count
        self._scratch = np.empty(max(_CHUNK, size), np.uint64)
        self._sized: dict[int, _Sized] = {}
        """By words of a packet."""
