"""Whether a seccomp profile holds a container at least as an engine's own does. Pure.

What gives a process a namespace, a file system or a part of the kernel that its container has not must be refused.
Nobody knows all calls that do, and kernels learn others: none is let through but those of Skytether's own profile, as
that lets them through. An engine reads keys in any case, and of a key that stands twice both: only exact keys are
taken, each of them once.
"""

from __future__ import annotations

import errno
import json
from collections.abc import Mapping
from typing import Any

from .seccomp_calls import CALLS

_REFUSES = {f"SCMP_ACT_{word}" for word in ("ERRNO", "KILL_PROCESS", "TRAP")}
"""None that ends one thread: runc has several, and the others wait for ever, and whoever started it."""
_LETS = "SCMP_ACT_ALLOW"
"""Others (``NOTIFY``, ``TRACE``) have a call wait for somebody who may not be there, or end a thread."""
_NEW_NAMESPACES = 0x7E020000
"""Flags of ``clone``."""
_FLAGS_SECOND = {"s390", "s390x"}
"""Where they are its second argument."""
_GUARDS = {"CAP_NET_ADMIN"}
"""What a container may have of rights: an entry for others of them never applies."""
_NATIVE = {"SCMP_ARCH_X86_64", "SCMP_ARCH_AARCH64"}
"""For the 32 bits beside them, what makes sockets has its arguments in memory, where no filter sees them."""
_FAMILIES = {1, 2, 10, 16}
"""Of sockets: AF_UNIX, AF_INET, AF_INET6, AF_NETLINK. Others lead to the kernel's ciphers, or to the machine below this
one, which has no network of its own for each container."""
_OF_FILTERS = [{"index": 0, "value": 16, "op": "SCMP_CMP_EQ"}, {"index": 2, "value": 12, "op": "SCMP_CMP_EQ"}]
"""Arguments of sockets of AF_NETLINK, that for netfilter."""
_NEEDED = {"close", "close_range", "execve", "exit_group", "futex", "mmap", "openat", "read", "write"}
"""What runc calls by a container's profile before it is that container. Without one, it may never end, nor start."""
_AGAIN = {errno.EINTR, errno.EAGAIN}
_MOST_ERRNO = 4096
"""Of the kernel."""
_PROFILE = {"defaultAction", "defaultErrnoRet", "archMap", "architectures", "syscalls"}
_ARGUMENT = {"index", "value", "valueTwo", "op"}
_ENTRY = {"names", "name", "action", "errnoRet", "args", "comment", "includes", "excludes"}


def holds(text: str) -> bool:
    """Whether a profile (JSON, as Docker takes it) lets nothing of that through."""
    try:
        profile = json.loads(text, object_pairs_hook=once)
    except (ValueError, RecursionError):
        return False
    if not isinstance(profile, dict) or profile.keys() - _PROFILE or not _refuses(profile.get("defaultAction")):
        return False
    if not _is_error(profile.get("defaultErrnoRet")):
        return False
    arches, maps = profile.get("architectures") or [], profile.get("archMap") or []
    if not isinstance(arches, list) or set(map(str, arches)) - _NATIVE:
        return False
    if not isinstance(maps, list) or not all(map(_is_alone, maps)):
        return False
    entries = profile.get("syscalls") or []
    if not isinstance(entries, list) or not all(isinstance(one, dict) and _closed(one) for one in entries):
        return False
    refused, always = set[str](), set[str]()
    for one in entries:
        if _refuses(one.get("action")):
            refused |= _named(one)
        elif not any(one.get(key) for key in ("args", "includes", "excludes")):
            always |= _named(one)
    return always >= _NEEDED and not refused & _NEEDED


def keeps_in(text: str) -> bool:
    """Whether by a profile that holds the right of a guard is one over its own network alone.

    A container is root of the machine's own user namespace, and so its right is one over all networks, where it can
    name them. A socket for routes names another one by a number, and there is one for the machine's: the other end of
    the container's link is there. By it a container sees, makes, moves and ends links of the machine. And a socket of
    another network is that network: one of AF_UNIX, also half of a pair, is given it by whoever is in there.
    """
    return all(_makes_few(one) for one in json.loads(text).get("syscalls") or [])


def _refuses(action: Any) -> bool:
    return isinstance(action, str) and action in _REFUSES


def _is_alone(arches: Any) -> bool:
    known = isinstance(arches, dict) and not arches.keys() - {"architecture", "subArchitectures"}
    return known and not arches.get("subArchitectures")


def _makes_few(entry: Mapping[str, Any]) -> bool:
    names = _named(entry)
    made = "socketpair" not in names and ("socket" not in names or entry.get("args") == _OF_FILTERS)
    return made or _refuses(entry.get("action"))


def _named(entry: Mapping[str, Any]) -> set[Any]:
    return {*(entry.get("names") or []), entry.get("name")} - {None, ""}


def _is_error(number: Any) -> bool:
    """By zero a call that was not made seems to have gone well, and by others runc makes it again for ever.

    Of a number it keeps 16 bits.
    """
    return number is None or (type(number) is int and 0 < number < _MOST_ERRNO and number not in _AGAIN)


def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """For `json.loads`: raises ``ValueError`` where a key stands twice."""
    found = dict(pairs)
    if len(found) != len(pairs):
        raise ValueError
    return found


def _closed(entry: Mapping[str, Any]) -> bool:
    names, includes = entry.get("names") or [], entry.get("includes") or {}
    if entry.keys() - _ENTRY or not isinstance(names, list) or not isinstance(includes, dict):
        return False
    if not _is_error(entry.get("errnoRet")) or not all(isinstance(one, str) for one in (*names, entry.get("name", ""))):
        return False
    if includes.keys() - {"caps", "arches", "minKernel"} or not isinstance(includes.get("caps") or [], list):
        return False
    if _refuses(entry.get("action")):
        return True
    if entry.get("action") != _LETS:
        return False
    if set(map(str, includes.get("caps") or [])) - _GUARDS:
        return True
    allowed = _named(entry)
    if not allowed <= CALLS:
        return False
    if "socket" in allowed and not _of_known_families(entry.get("args")):
        return False
    return "clone" not in allowed or _within(entry.get("args"), includes.get("arches"))


def _of_known_families(arguments: Any) -> bool:
    given = [one for one in arguments if isinstance(one, dict)] if isinstance(arguments, list) else []
    found = {one.get("index"): one for one in given if type(one.get("index")) is int}
    family = found.get(0, {})
    if not given or len(found) != len(arguments) or any(one.keys() - _ARGUMENT for one in given):
        return False  # of two for one place, either is enough
    return family.get("op") == "SCMP_CMP_EQ" and type(family.get("value")) is int and family["value"] in _FAMILIES


def _within(arguments: Any, arches: Any) -> bool:
    """Whether a ``clone`` is let through without a new namespace only: by its flags, the first of its arguments."""
    index = 1 if isinstance(arches, list) and arches and set(map(str, arches)) <= _FLAGS_SECOND else 0
    return bool(arguments == [{"index": index, "value": _NEW_NAMESPACES, "valueTwo": 0, "op": "SCMP_CMP_MASKED_EQ"}])
