"""What the kernel still has of what a process sent by TCP, and sends again, whether that process runs or not."""

from __future__ import annotations

import os
from contextlib import suppress

_TABLES = "tcp", "tcp6"
_QUEUES, _INODE = 4, 9
"""Columns of /proc/PID/net/tcp."""


def is_anything_unacknowledged(pid: int) -> bool:
    """Whether a connection of a process holds bytes that the other end's kernel has not acknowledged, of Linux.

    False also where nobody can know it: the process is gone, or is not ours to look at.
    """
    folder = f"/proc/{pid}"
    with suppress(OSError, ValueError, IndexError):
        waiting = {inode for table in _TABLES for inode in _waiting(f"{folder}/net/{table}")}
        return bool(waiting) and not waiting.isdisjoint(_files(folder))
    return False


def _waiting(table: str) -> list[str]:
    """Sockets of that network that have something to be acknowledged, as `_files` names them."""
    with open(table, encoding="ascii") as file:
        rows = [line.split() for line in file.readlines()[1:]]
    return [f"socket:[{row[_INODE]}]" for row in rows if int(row[_QUEUES].split(":")[0], 16)]


def _files(folder: str) -> set[str]:
    found = set()
    for name in os.listdir(f"{folder}/fd"):
        with suppress(OSError):  # closed meanwhile
            found.add(os.readlink(f"{folder}/fd/{name}"))
    return found
