"""Codec of a packet's clear header. Nothing here knows keys, sessions or time.

Every packet of every type starts with the same 32 bytes, big-endian::

    offset  size  field
         0     1  version (high four bits) and type (low four bits)
         1     8  id: HELLO has the session's; what a handshake made (and WELCOME) that handshake's own
         9     1  epoch: which handshake's keys seal this message (0 in handshake packets)
        10     6  message number, per direction and epoch: never repeats
        16     2  topic index: 0 for control, else position in the robot's topic table plus 1
        18     4  length of the sealed message
    --- the 22 bytes above are the same in all packets of a message ---
        22     2  block
        24     1  shard within the block: data shards first, then parity
        25     1  path
        26     4  packet number, per path and direction: the nonce, and for loss and burst statistics
        30     2  time of sending on the sender's clock, in units of 2**-14 s, for delay statistics
    --- DATA: then a whole message, sealed with these 32 bytes as associated data ---
    --- all other types: ---
        32     8  tag over everything else in the packet (``tags``)
        40        one shard; all shards of a message have the same size, a multiple of 4

Shard size and sealed length give the number of shards and blocks (``fragment.Shape``). So every byte of every packet
is authenticated before anything but a counter of refused packets changes.
"""

from __future__ import annotations

import struct
from functools import lru_cache

import numpy as np
import numpy.typing as npt

VERSION = 3

DATA = VERSION << 4
HELLO = VERSION << 4 | 1
WELCOME = VERSION << 4 | 2
SHARD = VERSION << 4 | 3

HEADER = struct.Struct(">BQBHIHIHBBIH")
COMMON = struct.Struct(">BQBHIHI")
OWN = struct.Struct(">HBBIH")
KEYS = struct.Struct(">BQB")
"""What names the keys: type, id, epoch."""
BLOCK = struct.Struct(">BQBHIHIH")
"""What packets of the same block of the same message agree in."""
_SESSION = struct.Struct(">BQ")

HEADER_SIZE = HEADER.size
TAG_SIZE = 8
SHARD_AT = HEADER_SIZE + TAG_SIZE
COMMON_SIZE = COMMON.size
INDEX_AT = BLOCK.size
PATH_AT = 25
NONCE_AT = PATH_AT
"""Path and packet number, which follows: never twice under the same keys."""
NUMBER_AT = 26
TIME_AT = 30
HELLO_TYPE = HELLO & 15
"""In all versions, so that a relay routes what it cannot read."""

TICK = 2.0**-14
"""Seconds of one unit of the time of sending: 61 microseconds. It wraps after 4 s."""
TICKS = 2**16

Packets = npt.NDArray[np.void]

Fields = tuple[int, int, int, int, int, int, int, int, int, int, int]
"""type, id, epoch, message number, topic index, sealed length, block, shard, path, packet number, time."""


def push_common(kind: int, session_id: int, epoch: int, number: int, topic: int, length: int) -> bytes:
    """The part of the header that all shards of a message share."""
    return COMMON.pack(kind, session_id, epoch, number >> 32, number & 0xFFFFFFFF, topic, length)


def ticks(now: float) -> int:
    """A time as packets carry it."""
    return int(now / TICK) % TICKS


def push_shard(block: int, index: int, path: int, packet: int, time: int) -> bytes:
    """The part of the header that is a packet's own; ``time`` in ticks."""
    return OWN.pack(block, index, path, packet, time)


def pull_number(common: memoryview | bytes) -> int:
    """Message number in the common part of a header."""
    _, _, _, high, low, _, _ = COMMON.unpack_from(common)
    number: int = high << 32 | low
    return number


def pull_header(data: memoryview | bytes) -> Fields | None:
    """Both parts; None if the packet is shorter than a header. Values are not checked."""
    if len(data) < HEADER_SIZE:
        return None
    kind, session_id, epoch, high, low, topic, length, block, index, path, packet, time = HEADER.unpack_from(data)
    return kind, session_id, epoch, high << 32 | low, topic, length, block, index, path, packet, time


@lru_cache(maxsize=64)
def _layout(size: int) -> np.dtype[np.void]:
    keys, block, shard = f"V{KEYS.size}", f"V{BLOCK.size}", (np.uint8, (size - SHARD_AT,))
    fields = {
        "keys": (keys, 0), "block": (block, 0), "index": (np.uint8, INDEX_AT), "path": (np.uint8, PATH_AT),
        "number": (">u4", NUMBER_AT), "time": (">u2", TIME_AT), "shard": (shard, SHARD_AT),
    }  # fmt: skip
    formats, offsets = zip(*fields.values(), strict=True)
    return np.dtype({"names": list(fields), "formats": formats, "offsets": offsets, "itemsize": size})


def pull_packets(data: memoryview | bytes, count: int, size: int) -> Packets:
    """So many packets of the same size, one after the other, as an array that shares their memory; size > `SHARD_AT`.

    Fields: ``keys`` and ``block`` (bytes, as of `KEYS` and `BLOCK`), ``index``, ``path``, ``number``, ``time`` and
    ``shard`` (of each packet a row of bytes).
    """
    return np.frombuffer(data, _layout(size), count)


def peek_id(data: memoryview | bytes) -> tuple[bool, int] | None:
    """Whether a packet of any version is a HELLO, and its id; None if this cannot be one of our packets."""
    if len(data) < HEADER_SIZE:
        return None
    kind, number = _SESSION.unpack_from(data)
    return kind & 15 == HELLO_TYPE, number
