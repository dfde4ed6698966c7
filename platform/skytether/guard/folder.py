"""Whose a folder of sockets is, and who is at the other end of one: nobody else may take a stop in our stead."""

from __future__ import annotations

import os
import socket
import stat
import struct

_CREDENTIALS = struct.Struct("iII")


def objection(folder: str) -> str:
    """Why the sockets in a folder cannot be relied upon; empty: they can, for only its owner could put them there.

    The owner is the own user, root, or another one where not everybody may make folders: what systemd made in /run, a
    home. A group may write only where nobody can take away what is another's (the sticky bit).
    """
    try:
        place = os.path.realpath(folder, strict=True)
        found = os.lstat(place)
    except OSError as error:
        return f"{folder}: {error.strerror}"
    if not stat.S_ISDIR(found.st_mode):
        return f"{place} is no folder"
    above, ours = os.path.dirname(place), (0, os.geteuid())
    if found.st_mode & stat.S_IWOTH or _shared(found):
        return f"others may write to {place}: chmod go-w {place}"
    try:
        if found.st_uid not in ours and _writable(os.lstat(above)):
            return f"{place} belongs to the user {found.st_uid}, who may have made it to be taken for another"
        while True:
            over = os.lstat(above)
            if over.st_uid not in (*ours, found.st_uid) or _shared(over):
                return f"others may replace {place}, for they may write to {above}"
            if above == os.path.dirname(above):
                return ""
            above = os.path.dirname(above)
    except OSError as error:
        return f"{above}: {error.strerror}"


def trusted(folder: str) -> tuple[int, ...]:
    """The users who may be at the other end of a socket in a folder to which there is no objection."""
    return (0, os.geteuid(), os.stat(folder).st_uid)


def peer(link: socket.socket) -> int:
    """The user at the other end of a connected socket."""
    return _peer(link)[1]


def peer_process(link: socket.socket) -> int:
    """The process that made a socket pair."""
    return _peer(link)[0]


def _peer(link: socket.socket) -> tuple[int, int, int]:
    data = link.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    process, user, group = _CREDENTIALS.unpack(data)
    return process, user, group


def sender(ancillary: list[tuple[int, int, bytes]]) -> int | None:
    """The user who sent a datagram to a socket with SO_PASSCRED, as the kernel says; None: it does not."""
    for level, kind, data in ancillary:
        if (level, kind) == (socket.SOL_SOCKET, socket.SCM_CREDENTIALS):
            return int(_CREDENTIALS.unpack(data[: _CREDENTIALS.size])[1])
    return None


def _writable(found: os.stat_result) -> bool:
    return found.st_mode & (stat.S_IWGRP | stat.S_IWOTH) != 0


def _shared(found: os.stat_result) -> bool:
    return _writable(found) and not found.st_mode & stat.S_ISVTX
