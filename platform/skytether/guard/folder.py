"""Whose a folder of sockets is, and who is at the other end of one: nobody else may take a stop in our stead."""

from __future__ import annotations

import errno
import os
import socket
import stat
import struct

_CREDENTIALS = struct.Struct("iII")
ROOM = socket.CMSG_SPACE(_CREDENTIALS.size)
"""Of a sender's credentials, beside a datagram."""
_NOBODY = -1


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
    """The users who may be at the other end of a socket in a folder: root, the own one and the folder's owner.

    The owner not where everybody may make folders: there it may be somebody who came first.
    """
    place, ours = os.path.realpath(folder), (0, os.geteuid())
    owner = os.stat(place).st_uid
    if owner in ours or _writable(os.lstat(os.path.dirname(place))):
        return ours
    return (*ours, owner)


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


def sender(ancillary: list[tuple[int, int, bytes]]) -> tuple[int, int]:
    """User and group who sent a datagram to a socket with SO_PASSCRED, as the kernel says; -1: it does not."""
    for level, kind, data in ancillary:
        if (level, kind) == (socket.SOL_SOCKET, socket.SCM_CREDENTIALS):
            _, user, group = _CREDENTIALS.unpack(data[: _CREDENTIALS.size])
            return user, group
    return _NOBODY, _NOBODY


class Known:
    """Who may be at the other end of a datagram socket with a path: the own user, root and the folder's owner.

    Where the folder hands its group down (chgrp GROUP, chmod g+s), so may whoever has that as the group of their
    process (``Group=`` of a unit; further groups of a user do not count, for the kernel does not tell them).

    Args:
        path: Of the socket, or where it will be.
    """

    def __init__(self, path: str) -> None:
        self._path = path
        folder = os.path.dirname(path) or "."
        found = os.stat(folder)
        self._users = trusted(folder)
        self._group = found.st_gid if found.st_mode & stat.S_ISGID else _NOBODY

    @classmethod
    def of(cls, source: socket.socket) -> Known | None:
        """Of a socket that was bound; None: it has no path, and whoever has a way to it was given it."""
        path = source.getsockname() if source.family == socket.AF_UNIX else ""
        return cls(path) if path and isinstance(path, str) else None

    def objection(self, user: int, group: int) -> str:
        """Why somebody is not; empty: they are."""
        if user in self._users or group == self._group != _NOBODY:
            return ""
        who = f"the user {user}" if user != _NOBODY else "a user of whom nothing is known"
        return f"it is {who}, to whom {os.path.dirname(self._path)} does not belong"

    def objection_to_listener(self) -> str:
        """The same of who made the socket that is there now, its user alone. Raises OSError: there is none.

        Its group says nothing: in a folder that hands its own down every file has that, whoever made it.
        """
        for found in (os.lstat(self._path), os.stat(self._path)):  # who made a link may point it elsewhere at any time
            if why := self.objection(found.st_uid, _NOBODY):
                return why
        return ""


def check_listener(path: str, thing: str) -> None:
    """See whose socket a datagram would go to.

    Args:
        path: Of the socket.
        thing: What it would have.

    Raises:
        PermissionError: It is of somebody who may not have that.
        OSError: There is none.
    """
    if why := Known(path).objection_to_listener():
        raise PermissionError(errno.EPERM, f"whoever listens at {path} may not have {thing}: {why}")


def objection_to(link: socket.socket, path: str) -> str:
    """Why the other end of a connected stream socket may not be whom its path promises; empty: it may."""
    _, user, group = _peer(link)
    return Known(path).objection(user, group)


def _writable(found: os.stat_result) -> bool:
    return found.st_mode & (stat.S_IWGRP | stat.S_IWOTH) != 0


def _shared(found: os.stat_result) -> bool:
    return _writable(found) and not found.st_mode & stat.S_ISVTX
