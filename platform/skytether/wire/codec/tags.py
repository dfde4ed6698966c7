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
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from .crypto import BLOCK_ROOM, KEY_SIZE, block_cipher, key_stream
from .packet import HEADER_SIZE, INDEX_AT, SHARD_AT, TAG_SIZE

Rows = npt.NDArray[np.uint8]
"""Packets of the same size, a multiple of 4."""
Bools = npt.NDArray[np.bool_]
Words = npt.NDArray[np.uint64]

HEAD_SIZE = INDEX_AT
"""What all packets of a block of a message have in common; then comes the nonce."""
NONCE_WORDS = slice(HEAD_SIZE // 4, HEADER_SIZE // 4)
TAG_WORDS = slice(HEADER_SIZE // 4, (HEADER_SIZE + TAG_SIZE) // 4)
SECRET_SIZE = 2 * KEY_SIZE
_WORD = np.dtype("<u4")
_TAG = np.dtype("<u8")
_FIRST = 352
"""Words for which there are keys from the beginning: a packet of 1,400 bytes."""
_CHUNK = 64 * _FIRST
"""Words handled at a time: as a rule a whole batch, and no more memory for large packets that somebody makes up."""
_SIZES = 256
"""Sizes of packets remembered, and shapes of batches: more than are in use."""
_NONCE_AND_TAG = struct.Struct("4s4s8s")
_BLOCK = struct.Struct("<4sI4sI")
_MASK = 2**64 - 1


class _Sized(NamedTuple):
    """For packets of one size."""

    keys: Words
    constant: Words
    numbers: tuple[int, ...]
    """The same constant."""


class _Plan(NamedTuple):
    """Memory for batches of one shape, and the views of it that are needed: to make them takes longer than to sum."""

    wide: Words
    """The packets' words; all plans share it."""
    keys: Words
    constant: Words
    hashes: Words
    """Of each packet two, of which the upper halves count. The lower ones give way to the nonce."""
    nonces: npt.NDArray[np.uint32]
    blocks: memoryview
    made: memoryview
    tags: Words


class Tagger(Protocol):
    """Makes the tags of packets, one in each row."""

    def sums(self, heads: Rows, shards: Rows) -> Words | None:
        """What can be known of them before they are sent: of their headers up to the block, and their shards."""

    def put(self, rows: Rows, sums: Words | None = None) -> None:
        """Write them in their place, with the `sums` of these packets or without."""


class Tags:
    """Makes and checks the tags of one direction under one handshake's keys.

    Args:
        secret: `SECRET_SIZE` bytes.
    """

    __slots__ = ("_cipher", "_constant", "_keys", "_plans", "_scratch", "_secret", "_sized")

    def __init__(self, secret: bytes) -> None:
        self._secret = secret[:KEY_SIZE]
        self._cipher = block_cipher(secret[KEY_SIZE:])
        self._scratch = np.empty(0, np.uint64)
        """Memory for words, always the same: new pages cost more than the arithmetic."""
        self._extend(_FIRST)

    def sums(self, heads: Rows, shards: Rows) -> Words:
        """What of packets' hashes is known before they are sent, for `put`.

        Args:
            heads: The first `HEAD_SIZE` bytes of each.
            shards: Its shard.
        """
        words = shards.view(_WORD)
        count, size = words.shape
        keys, constant, _ = self._sized.get(size + SHARD_AT // 4) or self._prepare(size + SHARD_AT // 4)
        made = np.empty((count, 2), np.uint64)
        step = len(self._scratch) // size
        for start in range(0, count, step):
            part = words[start : start + step]
            wide = self._scratch[: part.size].reshape(part.shape)
            wide[...] = part
            np.einsum("ij,kj->ik", wide, keys[:, SHARD_AT // 4 :], out=made[start : start + step])
        made += np.einsum("ij,kj->ik", heads.view(_WORD).astype(np.uint64), keys[:, : HEAD_SIZE // 4])
        made += constant
        return made

    def put(self, rows: Rows, sums: Words | None = None) -> None:
        """Write the tags of packets in their place.

        Args:
            rows: The packets.
            sums: Of these packets, if they are at hand.
        """
        words = rows.view(_WORD)
        step = max(1, len(self._scratch) // words.shape[1])
        for start in range(0, len(words), step):
            part = words[start : start + step]
            known = None if sums is None else sums[start : start + step]
            part[:, TAG_WORDS].view(_TAG)[:, 0] = self._tags(part, known)

    def check(self, rows: Rows) -> Bools:
        """Which of these packets have the right tag. Takes the same time whichever bytes are wrong."""
        words = rows.view(_WORD)
        given = words[:, TAG_WORDS].view(_TAG)[:, 0]
        step = max(1, len(self._scratch) // words.shape[1])
        if len(words) <= step:
            right: Bools = self._tags(words) == given
            return right
        parts = range(0, len(words), step)
        return np.concatenate([self._tags(words[i : i + step]) == given[i : i + step] for i in parts])

    def check_one(self, data: memoryview | bytes) -> bool:
        """The same for one packet."""
        words = np.frombuffer(data, _WORD)
        keys, _, constant = self._sized.get(len(words)) or self._prepare(len(words))
        first, second = keys.dot(words).tolist()
        upper = (first + constant[0] & _MASK) >> 32, (second + constant[1] & _MASK) >> 32
        nonce, rest, tag = _NONCE_AND_TAG.unpack_from(data, 4 * NONCE_WORDS.start)
        block = _BLOCK.pack(nonce, upper[0], rest, upper[1])
        return hmac.compare_digest(self._cipher.update(block)[:TAG_SIZE], tag)

    def _tags(self, words: npt.NDArray[np.uint32], sums: Words | None = None) -> Words:
        """Tags of packets that fit the scratch memory; they change with the next call.

        Of each packet a block: hash and nonce, four bytes in turn.
        """
        shape = words.shape
        wide, keys, constant, hashes, nonces, blocks, made, tags = self._plans.get(shape) or self._plan(*shape)
        if sums is None:
            wide[...] = words
            np.einsum("ij,kj->ik", wide, keys, out=hashes)
            np.add(hashes, constant, hashes)
        else:
            hashes[...] = sums
        nonces[...] = words[:, NONCE_WORDS]
        self._cipher.update_into(blocks, made)
        return tags

    def _plan(self, count: int, size: int) -> _Plan:
        sized = self._sized.get(size) or self._prepare(size)
        if len(self._plans) == _SIZES:
            self._plans.clear()
        hashes = np.empty((count, 2), np.uint64)
        made = np.empty(16 * count + BLOCK_ROOM, np.uint8)
        plan = self._plans[count, size] = _Plan(
            wide=self._scratch[: count * size].reshape(count, size),
            keys=sized.keys,
            constant=sized.constant,
            hashes=hashes,
            nonces=hashes.view(_WORD)[:, ::2],
            blocks=hashes.view(np.uint8).reshape(-1).data,
            made=made.data,
            tags=made[: 16 * count].view(_TAG)[::2],
        )
        return plan

    def _prepare(self, size: int) -> _Sized:
        """Keys for packets of so many words, which also depend on the size itself."""
        if size > self._keys.shape[1]:
            self._extend(size)
        elif len(self._sized) == _SIZES:
            self._sized.clear()
        constant = self._constant[0] + self._constant[1] * np.uint64(size)
        made = self._sized[size] = _Sized(self._keys[:, :size], constant, tuple(constant.tolist()))
        return made

    def _extend(self, size: int) -> None:
        stream = np.frombuffer(key_stream(self._secret, 16 * (size + 2)), "<u8").astype(np.uint64).reshape(-1, 2)
        self._constant, self._keys = stream[:2], np.ascontiguousarray(stream[2:].T)
        self._keys[:, HEAD_SIZE // 4 : SHARD_AT // 4] = 0  # the nonce is in the block, and a tag cannot count itself
        self._scratch = np.empty(max(_CHUNK, size), np.uint64)
        self._sized: dict[int, _Sized] = {}
        """By words of a packet."""
        self._plans: dict[tuple[int, ...], _Plan] = {}
        """By packets, and words of each."""
