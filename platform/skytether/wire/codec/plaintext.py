"""What stands before the payload in a message's plaintext. Of all of it, only `INNER` is in every message."""

from __future__ import annotations

import struct

from .compression import FLAG, Compressed
from .crypto import TAG_SIZE

INNER = struct.Struct(">IQ")
"""Topic sequence, time of publishing in microseconds of the sender's clock with the highest bit set if the payload is
compressed."""
PREFIX = struct.Struct(">QI")
"""Then, of a reliable topic: sequence number, and how many numbers below it the sender has not given up."""
OVERHEAD = INNER.size + TAG_SIZE
"""Bytes that a sealed message has beyond prefix and payload."""


def push_inner(sequence: int, published_at: float, payload: bytes) -> bytes:
    """Start of a plaintext."""
    flag = FLAG if isinstance(payload, Compressed) else 0
    return INNER.pack(sequence & 0xFFFFFFFF, int(published_at * 1e6) | flag)
