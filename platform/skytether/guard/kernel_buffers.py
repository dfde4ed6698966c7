"""What the kernel still has of what a process sent by TCP, and sends again, whether that process runs or not."""

from __future__ import annotations

import os
from contextlib import suppress

_TABLES = "tcp", "tcp6"
_LOCAL, _STATE, _QUEUES, _INODE = 1, 3, 4, 9
"""Columns of /proc/PID/net/tcp."""
_LISTENS = "0A"


def is_anything_unacknowledged(pid: int) -> bool:
    """Whether somebody who connected to a process has not acknowledged all that it sent him, of Linux.

    False also where nobody can know it: the process is gone, or is not ours to look at.
    """
    folder = f"/proc/{pid}"
    with suppress(OSError, ValueError, IndexError):
        ours = _files(folder)
        rows = [row for table in _TABLES for row in _rows(f"{folder}/net/{table}") if f"socket:[{row[_INODE]}]" in ours]
        ports = {_port(row) for row in rows if row[_STATE] == _LISTENS}
        return any(
            int(row[_QUEUES].split(":")[0], 16) for row in rows if row[_STATE] != _LISTENS and _port(row) in ports
        )
    return False


def _rows(table: str) -> list[list[str]]:
    with open(table, encoding="ascii") as file:
        return [line.split() for line in file.readlines()[1:]]


def _port(row: list[str]) -> str:
    return row[_LOCAL].rpartition(":")[2]


def _files(folder: str) -> set[str]:
    found = set()
    for name in os.listdir(f"{folder}/fd"):
        with suppress(OSError):  # closed meanwhile
            found.add(os.readlink(f"{folder}/fd/{name}"))
    return found
