"""A small disk of its own for a folder: in memory, and seen only by the calling thread and what it starts."""

from __future__ import annotations

import ctypes
import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_CLONE_NEWNS = 0x00020000
_MS_REC_PRIVATE = 0x4000 | 0x40000


@contextmanager
def small_disk(folder: Path, size: int) -> Iterator[None]:
    """Mount it, and take it away at the end. Call it in a thread that ends soon: mounts stay private to that thread.

    Args:
        folder: To mount it at.
        size: Of the disk [bytes].

    Raises:
        OSError: It is not permitted here.
    """
    _call("unshare", _CLONE_NEWNS)
    _call("mount", b"none", b"/", None, _MS_REC_PRIVATE, None)
    _call("mount", b"tmpfs", os.fsencode(folder), b"tmpfs", 0, f"size={size}".encode())
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=False)  # noqa: S607 - wherever the system has it


def _call(name: str, *arguments: object) -> None:
    """One of the C library's calls that Python does not name."""
    library = ctypes.CDLL(None, use_errno=True)
    if getattr(library, name)(*arguments) != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number), name)
