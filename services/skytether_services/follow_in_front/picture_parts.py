"""What of a picture file makes its pixels: all else is left out before a decoder sees it.

A robot's camera may send anything. A decoder that walks through a million empty segments, unpacks a profile again and
again, or draws the same picture in ten thousand scans would hold up the robot for seconds, and longer.
"""

from __future__ import annotations

import re

_MOST_BYTES = 8_000_000
"""Of a file: more than any picture needs that is small enough to be looked at."""
_MOST_PARTS = 4_000
"""Segments of a JPEG, chunks of a PNG: 8 MB in the chunks of 8 kB that are usual are 1,000."""
_MOST_SCANS = 32
"""Of a progressive JPEG, each of which goes over all of the picture; 10 are usual."""

_JPEG, _PNG = b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n"
_SCAN, _END = 0xDA, 0xD9
_ADOBE = 0xEE
"""Tells how colours are coded."""
_FOR_PEOPLE = frozenset([*range(0xE0, 0xF0), 0xFE]) - {_ADOBE}
"""Application segments and comments of a JPEG (ITU-T T.81, table B.1)."""
_NEXT = re.compile(rb"\xff+[^\x00\xff\xd0-\xd7]")
"""A marker in a scan's data, in which 0xFF 0x00 is a byte, and 0xD0 to 0xD7 begin the coding anew."""
_PIXELS = frozenset({b"IHDR", b"PLTE", b"IDAT", b"IEND"})


def pixels_only(data: bytes) -> bytes:
    """The same file without what is not needed for its pixels.

    Raises:
        ValueError: It is neither JPEG nor PNG, or larger or in more parts than a picture of a camera is.
    """
    if len(data) > _MOST_BYTES:
        raise ValueError(f"it has {len(data)} bytes, more than {_MOST_BYTES}")
    if data.startswith(_JPEG):
        return _jpeg(data)
    if data.startswith(_PNG):
        return _png(data)
    raise ValueError("it is neither JPEG nor PNG")


def _jpeg(data: bytes) -> bytes:
    kept, place, scans = [data[:2]], 2, 0
    for _ in range(_MOST_PARTS):
        marker = data[place : place + 2]
        if len(marker) < 2 or marker[1] == _END:
            # Cut short or complete: the decoder will say.
            return b"".join([*kept, marker])
        if marker[0] != 0xFF or marker[1] < 0xC0:
            raise ValueError(f"no marker at byte {place}")
        if marker[1] == 0xFF:  # a byte that fills
            place += 1
            continue
        end = place + 2 + int.from_bytes(data[place + 2 : place + 4], "big")
        if marker[1] == _SCAN:
            scans += 1
            if scans > _MOST_SCANS:
                raise ValueError(f"it is drawn in more than {_MOST_SCANS} scans")
            found = _NEXT.search(data, end)
            end = found.end() - 2 if found else len(data)
        if marker[1] not in _FOR_PEOPLE:
            kept.append(data[place:end])
        place = end
    raise ValueError(f"it is in more than {_MOST_PARTS} parts")


def _png(data: bytes) -> bytes:
    kept, place = [_PNG], len(_PNG)
    for _ in range(_MOST_PARTS):
        kind = data[place + 4 : place + 8]
        end = place + 12 + int.from_bytes(data[place : place + 4], "big")
        if kind in _PIXELS:
            kept.append(data[place:end])
        if len(kind) < 4 or kind == b"IEND":
            return b"".join(kept)
        place = end
    raise ValueError(f"it is in more than {_MOST_PARTS} parts")
