"""TCPROS as bytes: connection headers and frames (wiki.ros.org/ROS/TCPROS). Pure.

A connection begins with a header from each side, ``name=value`` fields with their lengths before them. Then a topic's
messages follow as frames: four bytes of length, little-endian, and the message.
"""

from __future__ import annotations

import struct
from asyncio import StreamReader
from collections.abc import Mapping

MAX_HEADER = 4 * 2**20
"""Bytes of a header: it carries the definition of the type, with all types in it."""
MAX_MESSAGE = 16 * 2**20
"""Bytes of a message that is taken: as much as a session carries. Larger ones are left out."""
ANY = "*"
"""A type or a sum that fits every other."""
_LENGTH = struct.Struct("<I")
_CHUNK = 2**16


class HeaderError(ValueError):
    """Bytes that are no header."""


def pack_header(fields: Mapping[str, str]) -> bytes:
    """A header with its length."""
    parts = [f"{name}={value}".encode() for name, value in fields.items()]
    body = b"".join(_LENGTH.pack(len(part)) + part for part in parts)
    return _LENGTH.pack(len(body)) + body


def unpack_header(body: bytes) -> dict[str, str]:
    """Fields of a header, given without its length. Text that is no UTF-8 is kept as far as it can be.

    Raises:
        HeaderError: It is none.
    """
    fields: dict[str, str] = {}
    at = 0
    while at < len(body):
        end = at + 4
        if end > len(body):
            raise HeaderError("a connection header ends within a length")
        end += _LENGTH.unpack_from(body, at)[0]
        if end > len(body):
            raise HeaderError("a field of a connection header is longer than the header")
        name, equals, value = body[at + 4 : end].partition(b"=")
        if not equals:
            raise HeaderError("a field of a connection header has no '='")
        fields[name.decode(errors="replace")] = value.decode(errors="replace")
        at = end
    return fields


def pack_frame(payload: bytes | memoryview) -> bytes:
    """A message with its length."""
    return b"".join((_LENGTH.pack(len(payload)), payload))


async def read_header(reader: StreamReader) -> dict[str, str]:
    """The header that a connection begins with.

    Raises:
        HeaderError: It is none, or too long.
        EOFError: The connection ended.
    """
    (length,) = _LENGTH.unpack(await reader.readexactly(4))
    if length > MAX_HEADER:
        raise HeaderError(f"a connection header of {length} bytes; {MAX_HEADER} are taken")
    return unpack_header(await reader.readexactly(length))


async def read_frame(reader: StreamReader, limit: int = MAX_MESSAGE) -> bytes | int:
    """The next message; its length alone if that is more than ``limit``: its bytes are then passed over.

    Raises:
        EOFError: The connection ended.
    """
    (length,) = _LENGTH.unpack(await reader.readexactly(4))
    if length <= limit:
        return await reader.readexactly(length)
    left: int = length
    while left:
        left -= len(await reader.readexactly(min(left, _CHUNK)))
    return int(length)


def pack_answer(outcome: bytes | str) -> bytes:
    """A service's answer: the response's bytes, or a sentence that says why there is none."""
    if isinstance(outcome, str):
        return b"\0" + pack_frame(outcome.encode())
    return b"\1" + pack_frame(outcome)


def sums_differ(ours: str, theirs: str) -> bool:
    """Whether two MD5 sums exclude each other; an unknown or a wild one fits every other."""
    return ours not in ("", ANY) and theirs not in ("", ANY) and ours != theirs
