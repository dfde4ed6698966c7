"""Whether a seccomp profile holds a container at least as an engine's own does. Pure.

What gives a process a namespace, a file system or a part of the kernel that its container has not must be refused. An
engine reads keys in any case, and of a key that stands twice both: only exact keys are taken, each of them once, and
plain names of calls.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

_REFUSES = {f"SCMP_ACT_{word}" for word in ("ERRNO", "KILL", "KILL_PROCESS", "KILL_THREAD", "TRAP")}
_WAYS_OUT = {
    *(
        "unshare",
        "setns",
        "clone3",
        "mount",
        "umount",
        "umount2",
        "pivot_root",
        "fsopen",
        "fsconfig",
        "fsmount",
        "fspick",
    ),
    *("move_mount", "open_tree", "mount_setattr", "open_by_handle_at", "bpf", "perf_event_open", "userfaultfd"),
    *("init_module", "finit_module", "delete_module", "create_module", "kexec_load", "kexec_file_load", "reboot"),
    # Newer engines refuse them, or what they do with others' processes and memory.
    *("io_uring_setup", "io_uring_enter", "io_uring_register", "process_vm_readv", "process_vm_writev", "kcmp"),
    *("open_tree_attr", "uselib", "ustat", "sysfs", "_sysctl", "iopl", "ioperm", "lookup_dcookie", "vm86old"),
    "socketcall",  # whose arguments are in memory, where no filter sees them
    *("add_key", "keyctl", "request_key", "quotactl", "swapon", "swapoff", "acct", "syslog", "nfsservctl", "vm86"),
}
_CALL = re.compile("[a-z_][a-z0-9_]*")
_NEW_NAMESPACES = 0x7E020000
"""Flags of ``clone``."""
_FLAGS_SECOND = {"s390", "s390x"}
"""Where they are its second argument."""
_GUARDS = {"CAP_NET_ADMIN"}
"""What a container may have of rights: an entry for others of them never applies."""
_ONE_FAMILY = tuple([{"index": 0, "value": family, "op": "SCMP_CMP_EQ"}] for family in (1, 2, 10))
_OF_FILTERS = [{"index": 0, "value": 16, "op": "SCMP_CMP_EQ"}, {"index": 2, "value": 12, "op": "SCMP_CMP_EQ"}]
"""Arguments of sockets: of AF_UNIX, AF_INET and AF_INET6; and of AF_NETLINK that for netfilter."""
_AF_ALG, _AF_VSOCK = 38, 40
"""Families of sockets that newer engines refuse: to the kernel's ciphers, and to the machine below this one, which has
no network of its own for each container. An `NE` or a `GT` refuses neither: of a family, the kernel reads half of what
a filter compares."""
_PROFILE = {"defaultAction", "defaultErrnoRet", "archMap", "architectures", "syscalls"}
_ARGUMENT = {"index", "value", "valueTwo", "op"}
_ENTRY = {"names", "name", "action", "errnoRet", "args", "comment", "includes", "excludes"}


def holds(text: str) -> bool:
    """Whether a profile (JSON, as Docker takes it) lets nothing of that through."""
    try:
        profile = json.loads(text, object_pairs_hook=once)
    except (ValueError, RecursionError):
        return False
    if not isinstance(profile, dict) or profile.keys() - _PROFILE or profile.get("defaultAction") not in _REFUSES:
        return False
    entries = profile.get("syscalls") or []
    return isinstance(entries, list) and all(isinstance(one, dict) and _closed(one) for one in entries)


def keeps_in(text: str) -> bool:
    """Whether by a profile that holds the right of a guard is one over its own network alone.

    A container is root of the machine's own user namespace, and so its right is one over all networks, where it can
    name them. A socket for routes names another one by a number, and there is one for the machine's: the other end of
    the container's link is there. By it a container sees, makes, moves and ends links of the machine.
    """
    profile = json.loads(text)
    maps = profile.get("archMap") or []
    # In 32 bits sockets are made by what a filter does not see into.
    if profile.get("architectures") or not isinstance(maps, list) or not all(map(_is_alone, maps)):
        return False
    return all(_makes_few(one) for one in profile.get("syscalls") or [])


def _is_alone(arches: Any) -> bool:
    known = isinstance(arches, dict) and not arches.keys() - {"architecture", "subArchitectures"}
    return known and not arches.get("subArchitectures")


def _makes_few(entry: Mapping[str, Any]) -> bool:
    names = [*(entry.get("names") or []), entry.get("name")]
    if entry.get("action") in _REFUSES or not ("socket" in names or "socketcall" in names):
        return True
    return "socketcall" not in names and (entry.get("args") == _OF_FILTERS or entry.get("args") in _ONE_FAMILY)


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
    if includes.keys() - {"caps", "arches", "minKernel"} or not isinstance(includes.get("caps") or [], list):
        return False
    if entry.get("action") in _REFUSES or set(map(str, includes.get("caps") or [])) - _GUARDS:
        return True
    allowed = [*names, *filter(None, [entry.get("name")])]
    # Another spelling may mean one of them all the same: what looks it up in C ends it at its first zero.
    if not all(isinstance(name, str) and _CALL.fullmatch(name) for name in allowed):
        return False
    if _WAYS_OUT & set(allowed) or ("socket" in allowed and not _of_known_families(entry.get("args"))):
        return False
    return "clone" not in allowed or _within(entry.get("args"), includes.get("arches"))


def _of_known_families(arguments: Any) -> bool:
    given = [one for one in arguments if isinstance(one, dict)] if isinstance(arguments, list) else []
    found = {one.get("index"): one for one in given if type(one.get("index")) is int}
    family = found.get(0, {})
    if not given or len(found) != len(arguments) or any(one.keys() - _ARGUMENT for one in given):
        return False  # of two for one place, either is enough
    value = family.get("value")
    if type(value) is not int:
        return False
    return (family.get("op") == "SCMP_CMP_LT" and value <= _AF_ALG) or (
        family.get("op") == "SCMP_CMP_EQ" and value < 1 << 32 and value not in (_AF_ALG, _AF_VSOCK)
    )


def _within(arguments: Any, arches: Any) -> bool:
    """Whether a ``clone`` is let through without a new namespace only: by its flags, the first of its arguments."""
    index = 1 if isinstance(arches, list) and arches and set(map(str, arches)) <= _FLAGS_SECOND else 0
    return bool(arguments == [{"index": index, "value": _NEW_NAMESPACES, "valueTwo": 0, "op": "SCMP_CMP_MASKED_EQ"}])
