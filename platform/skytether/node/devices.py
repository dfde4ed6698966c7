"""Files of devices in images, by which an engine would give away what is on a machine's disk.

As it fetches a file of a container, it opens what that has become meanwhile, as root and with no rule for devices: by a
link to the file of a disk, what is on that. Nobody in a container makes such a file, but an image may have one.
"""

from __future__ import annotations

import io
import tarfile
import time
from collections.abc import Callable

from skytether.api.printable import printable

_HARMLESS = {(tarfile.CHRTYPE, *numbers) for numbers in ((1, 3), (1, 5), (1, 7), (1, 8), (1, 9), (5, 0), (5, 2))}
"""Devices that anybody may read: null, zero, full, random, urandom, tty and ptmx. Some tools that make images leave
their files there."""
_MOST_NAMES = 3000
"""Bytes that an archive says of an entry beside its head. An engine leaves out what is at a path that is longer than
the kernel takes (4096), though links may lead there."""
_BLOCK, _PIECE = 512, 1 << 20
_PATIENCE_S = 900.0
_MOST_TOLD = 80


def device_in(export: io.BufferedIOBase, clock: Callable[[], float] = time.monotonic) -> str | None:
    """Why an engine must not read files of a container with these, in a few words; None: nothing speaks against it.

    Args:
        export: All files of an image, as the archive that an engine makes of them. Its heads are read one by one; where
            the length of a file is told elsewhere, it counts as too large.
        clock: Seconds.

    Raises:
        ValueError: It is not whole, or takes too long.
    """
    until = clock() + _PATIENCE_S
    while (head := _exactly(export, _BLOCK)).strip(b"\0"):
        if clock() > until:
            raise ValueError(f"there is more in it than can be looked at in {_PATIENCE_S:g} s")
        try:
            entry = tarfile.TarInfo.frombuf(head, "utf-8", "surrogateescape")
        except tarfile.TarError as error:
            raise ValueError(f"its engine sends no archive: {error}") from error
        name, padded = printable(entry.name, lines=False)[:_MOST_TOLD], -(-entry.size // _BLOCK) * _BLOCK
        if entry.type in (tarfile.REGTYPE, tarfile.AREGTYPE):
            while padded:
                padded -= len(_exactly(export, min(padded, _PIECE)))
        elif entry.size > _MOST_NAMES:
            return f"{name} is at a path that is too long"
        elif b" size=" in _exactly(export, padded):
            return f"{name} is too large"
        elif (entry.ischr() or entry.isblk()) and (entry.type, entry.devmajor, entry.devminor) not in _HARMLESS:
            return f"{name} is a device"
    while piece := export.read(_PIECE):
        if piece.strip(b"\0"):
            raise ValueError("its engine sends something else after an archive")
    return None


def _exactly(source: io.BufferedIOBase, size: int) -> bytes:
    if len(found := source.read(size)) != size:
        raise ValueError("its engine sends half of an archive")
    return found
