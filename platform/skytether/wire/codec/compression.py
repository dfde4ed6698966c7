"""Messages made smaller before they are sealed, where a topic asks for it (`Topic.compression`).

A bit beside the time of publishing, inside what is sealed, tells a compressed message; so a message that does not
shrink travels as it is, and a receiver needs no setting.
"""

from __future__ import annotations

import sys

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

LEVEL = 1
"""The fastest: a message is wanted soon, and higher levels save little more on what robots send."""
LEAST = 128
"""Bytes below which nothing is gained."""
WINDOW_LOG = 24
"""Largest window that a peer may make this end allocate: 16 MiB."""
FLAG = 1 << 63
"""In the time of publishing."""


class Compressed(bytes):
    """A compressed payload; ``original`` is the size it had."""

    original: int


class Packed(bytes):
    """A payload as it came, compressed: small, whatever it grows to until it is taken."""


def compress(payload: bytes) -> bytes:
    """`Compressed` if that is smaller, else the same."""
    if len(payload) < LEAST:
        return payload
    smaller = Compressed(zstd.compress(payload, LEVEL))
    if len(smaller) >= len(payload):
        return payload
    smaller.original = len(payload)
    return smaller


def decompress(data: bytes | memoryview, limit: int) -> bytes | None:
    """What was compressed; None if it is nothing of the kind, or more than ``limit`` bytes."""
    try:
        if (zstd.get_frame_info(data).decompressed_size or 0) > limit:
            return None
        reader = zstd.ZstdDecompressor(options={zstd.DecompressionParameter.window_log_max: WINDOW_LOG})
        payload = reader.decompress(data, limit)
    except zstd.ZstdError:
        return None
    return payload if reader.eof else None


def unpacked_size(data: bytes | memoryview, limit: int) -> int | None:
    """Bytes that it says to grow to; None if it says nothing of the kind, or more than ``limit`` bytes."""
    try:
        size = zstd.get_frame_info(data).decompressed_size
    except zstd.ZstdError:
        return None
    return size if size is not None and size <= limit else None


def original_size(payload: bytes) -> int:
    """Bytes that were published."""
    return payload.original if isinstance(payload, Compressed) else len(payload)
