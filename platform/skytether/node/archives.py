"""Whether an engine may look into a container's files while that runs, and start it beside others.

For that, engines mount its volumes at the paths of its files, from the outside: look whether there is a link on the
way, then mount. Whoever can move a folder on that way in between has his volume mounted anywhere on the machine. So
all of the way must be such that nobody moves it: files that do not change, and no link to where they do.

Whoever unpacks an archive could change them all the same, by a link in it: an engine unpacks into a container's root
from the outside, follows links in there, and minds no root that is mounted read-only. With ``/dev`` a link there, runc
makes files in what that is on the machine. So of archives a grant is passed on, written anew.
"""

from __future__ import annotations

import base64
import io
import json
import posixpath
import re
import tarfile
from collections.abc import Mapping
from pathlib import PurePosixPath
from typing import Any

from .engine_rules import DATA, FOLDER

_FILES = ("/etc/hosts", "/etc/hostname", "/etc/resolv.conf")
"""That an engine mounts in each container."""
_KERNEL = re.compile(r"/(?:dev|proc|sys)(?:/.*)?", re.DOTALL)
"""What an engine mounts in each container beside, and holds it by."""
_MOST_MOUNTS, _MOST_WAYS = 64, 128
"""Of a container, and folders on the ways to them: an engine mounts all of the first in the machine's own tree, which
has room for some, whenever it looks into that container; the node asks for each of the second."""
STAT = "X-Docker-Container-Path-Stat"
_LINK, _NO_FILE = 1 << 27, 1 << 19
"""Go's bits in a file's mode: of a link, and the lowest of those that say that it is none."""
_USERS = {"/etc/passwd", "/etc/group"}
"""An engine reads them as it starts a container: of a pipe it waits for ever, of a device it takes all that comes, and
of a file it keeps each line that fits."""
_SBIN, _SBINS = "/sbin", ("/bin", "/sbin", "/usr/bin", "/usr/sbin")
"""Where an engine mounts its own first process, and where a link may lead that an image has there. A volume over that
would have another in its place; so would one over what a link there leads to, which is mounted later."""
_INIT = "docker-init"
_MOST_USERS = 1 << 20
"""Bytes in one of these."""
_BLOCK = 512
_FOLDERS = {FOLDER: re.compile("instance"), DATA: re.compile("[A-Za-z0-9_-][A-Za-z0-9_.-]{0,80}")}
"""Folders that are put in each."""
_GRANT = "instance/grant.json"
"""The file that is put below `FOLDER`."""
_MOST_ENTRIES = 16
_MOST_ID = 1 << 20
"""Of a user."""


def cleaned(archive: bytes, where: str) -> bytes | None:
    """An archive with the same folders and the same grant, and nothing else; None: there is something else in it.

    ``where``: the folder that it is put in.

    Its heads are read one by one: what says of the next one how it is to be read is something else. The grant's folder
    comes before it: an image may have put a link there, which becomes a folder so.
    """
    buffer, place, folders = io.BytesIO(), 0, set[str]()
    with tarfile.open(fileobj=buffer, mode="w", format=tarfile.USTAR_FORMAT) as tar:
        for _ in range(_MOST_ENTRIES):
            head = archive[place : place + _BLOCK]
            if not head.strip(b"\0"):
                return _ended(tar, buffer) if not archive[place:].strip(b"\0") else None
            try:
                entry = tarfile.TarInfo.frombuf(head, "ascii", "strict")
            except (tarfile.TarError, ValueError):
                return None
            made, content = tarfile.TarInfo(entry.name), b""
            known = posixpath.dirname(entry.name) in folders
            if entry.type == tarfile.REGTYPE and (where, entry.name) == (FOLDER, _GRANT) and known and entry.size >= 0:
                content = archive[place + _BLOCK : place + _BLOCK + entry.size]
            elif entry.type != tarfile.DIRTYPE or not _FOLDERS[where].fullmatch(entry.name):
                return None
            if len(content) != entry.size or not (0 <= entry.uid < _MOST_ID and 0 <= entry.gid < _MOST_ID):
                return None
            made.type, made.mode, made.uid, made.gid = entry.type, entry.mode & 0o777, entry.uid, entry.gid
            made.size = len(content)
            tar.addfile(made, io.BytesIO(content))
            folders |= {entry.name} - {_GRANT}
            place += _BLOCK + -(-len(content) // _BLOCK) * _BLOCK
    return None


def _ended(tar: tarfile.TarFile, buffer: io.BytesIO) -> bytes:
    tar.close()
    return buffer.getvalue()


def moved(inspected: Mapping[str, Any]) -> str | None:
    """Why the way to something in a container could be moved by what runs there or beside it; None: by nobody.

    What is in a volume could: a container has that alone, but may hand an open folder of it to another one, where no
    mount holds what is in there.
    """
    if (inspected.get("HostConfig") or {}).get("ReadonlyRootfs") is not True:
        return "it may change its own files"
    mounts = [str(one.get("Destination")) for one in inspected.get("Mounts") or ()]
    if len(mounts) > _MOST_MOUNTS or len(ways(inspected)) > _MOST_WAYS:
        return "it has too many mounts, or at paths that are too long"
    made = (*mounts, *_in_memory(inspected))
    for path in (*made, *_FILES):
        if path != "/" + posixpath.normpath(path).lstrip("/"):  # which keeps two slashes at its beginning
            # Of a volume that an image names so: what it is in or at is said by no comparison here.
            return f"{path or 'nothing'} is no whole path"
        if _KERNEL.fullmatch(path):
            return f"{path} is the kernel's"
        for above in mounts:
            if path.startswith(f"{above.rstrip('/')}/"):
                return f"{path} is in {above}, where things can be moved"
    for path in made:
        if any(f"{folder}/{_INIT}/".startswith(f"{path.rstrip('/')}/") for folder in _SBINS):
            return f"{path} is where the engine's own first process is"
    # Nothing is mounted there that the kernel would hold: what ran could leave a pipe, for the next start.
    users = (path for path in sorted(_USERS) if any(path == one or path.startswith(f"{one}/") for one in mounts))
    return next((f"{path} is in a volume, where things can be moved" for path in users), None)


def _in_memory(inspected: Mapping[str, Any]) -> list[str]:
    paths = (inspected.get("HostConfig") or {}).get("Tmpfs") or ()
    return [posixpath.normpath(f"/{path.strip('/')}") for path in paths]


def ways(inspected: Mapping[str, Any]) -> set[str]:
    """All folders and files that must be no links, in the image of a container."""
    mounts = (str(one["Destination"]) for one in inspected.get("Mounts") or ())
    ends = [PurePosixPath(path) for path in (*mounts, *_FILES, *_in_memory(inspected))]
    parts = {str(part) for end in ends for part in (end, *end.parents) if part != PurePosixPath("/")}
    return _USERS | {_SBIN, f"{_SBIN}/{_INIT}"} | parts


def pull_stat(headers: Mapping[str, str]) -> dict[str, Any] | None:
    """What an engine says of one file in the heads of its answer, whose names are in lower case."""
    try:
        stat = json.loads(base64.b64decode(headers[STAT.lower()]))
        return {
            "size": int(stat["size"]),
            "mode": int(stat["mode"]),
            "mtime": str(stat["mtime"]),
            "linkTarget": str(stat["linkTarget"]),
        }
    except (LookupError, TypeError, ValueError):
        return None


def push_stat(name: str, stat: Mapping[str, Any]) -> str:
    """The same as an engine says it of a file, which is no link."""
    return base64.b64encode(json.dumps({**stat, "name": name, "linkTarget": ""}).encode()).decode()


def is_odd(stat: Mapping[str, Any]) -> bool:
    """Whether it is no file, but a folder, a link, a device, or a pipe."""
    return bool(stat["mode"] & -_NO_FILE)


def misleads(path: str, stat: Mapping[str, Any]) -> bool:
    """Whether what an image has at a path is a link, or no file where there must be one, or a large one."""
    if path in _USERS:
        return is_odd(stat) or stat["size"] > _MOST_USERS
    if path == _SBIN and stat["linkTarget"] in _SBINS:
        return False
    return bool(stat["mode"] & _LINK)


def must_be_read(path: str, stat: Mapping[str, Any]) -> bool:
    """Whether it is a link whose own words count, see `leads_straight`: an engine tells only where it ends."""
    return path == _SBIN and bool(stat["mode"] & _LINK)


def leads_straight(archive: bytes, end: str) -> bool:
    """Whether a link, as an engine packs it, leads to its end by no other link: that could lead through a volume."""
    try:
        with tarfile.open(fileobj=io.BytesIO(archive), mode="r:") as tar:
            link = tar.next()
    except (tarfile.TarError, OSError, ValueError):
        return False
    return link is not None and link.issym() and link.linkname in (end, end.removeprefix("/"))
