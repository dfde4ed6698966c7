"""What ``rmw_zenoh_cpp`` attaches to each message, request and response (its docs/design.md, "Publishers")."""

from __future__ import annotations

import struct
from dataclasses import dataclass

_FORM = struct.Struct("<qqB16s")
GID_BYTES = 16


@dataclass(frozen=True, slots=True)
class Attachment:
    """Who sent it and when.

    Attributes:
        sequence: Of this publisher or client, from 1; a response carries that of its request.
        stamp: Nanoseconds since the Unix epoch.
        gid: 16 bytes that name the publisher or client.
    """

    sequence: int
    stamp: int
    gid: bytes


def push_attachment(attachment: Attachment) -> bytes:
    """Sequence number and time as little-endian int64, the GID after its length."""
    return _FORM.pack(attachment.sequence, attachment.stamp, GID_BYTES, attachment.gid)


def pull_attachment(data: bytes) -> Attachment | None:
    """Inverse of `push_attachment`; None for what is no attachment."""
    if len(data) != _FORM.size:
        return None
    sequence, stamp, length, gid = _FORM.unpack(data)
    return Attachment(sequence, stamp, gid) if length == GID_BYTES else None
