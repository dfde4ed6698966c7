"""Gives up rights, then becomes a service: ``python -I -S confine.py '{"command": [...], ...}'`` (Linux).

Run as a file, with the standard library alone, so that it costs a start some 20 ms. What is given up, as far as the
orchestrator asks for it (``confinement.py`` says what and why): another user, mounts of its own in which folders are
covered, Landlock, seccomp. It only ever takes away, and what was asked for and cannot be done ends it: the service is
not run with more. With ``"probe": true`` it says, as JSON, what this machine has, and runs nothing; with ``"end"`` it
ends all processes of a user.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import platform
import resource
import signal
import struct
import sys
from typing import Any

_LIBC = ctypes.CDLL(None, use_errno=True)
_CLONE_NEWNS, _CLONE_NEWIPC = 0x0002_0000, 0x0800_0000
_MS_RDONLY, _MS_NOSUID, _MS_NODEV, _MS_NOEXEC, _MS_REMOUNT = 1, 2, 4, 8, 32
_MS_BIND, _MS_REC, _MS_PRIVATE = 4096, 16384, 1 << 18
_PR_CAPBSET_DROP, _PR_SET_NO_NEW_PRIVS, _PR_SET_SECCOMP, _SECCOMP_MODE_FILTER = 24, 38, 22, 2
_CAPABILITIES = 64
_ENDER = 65_520
"""A user that no instance is, nor anybody else."""
_SCRATCH = ("/tmp", "/var/tmp", "/dev/shm")  # noqa: S108 (covered, so these are its own)
"""Covered folders that the service may write into."""
_SCRATCH_SIZE = "64m"

# Landlock, linux/landlock.h. The three calls have the same number on all architectures.
_CREATE, _ADD_RULE, _RESTRICT = 444, 445, 446
_RULE_PATH = 1
_EXECUTE, _WRITE_FILE, _READ_FILE, _READ_DIR = 1, 2, 4, 8
_REFER, _TRUNCATE, _IOCTL_DEV = 1 << 13, 1 << 14, 1 << 15
_FIRST = (1 << 13) - 1
"""All rights of its first version."""
_READ = _EXECUTE | _READ_FILE | _READ_DIR
_OF_FILES = _EXECUTE | _WRITE_FILE | _READ_FILE | _TRUNCATE | _IOCTL_DEV
HOLDS_TRUNCATE = 3
"""The first version of Landlock that does."""
_SCOPE_ABSTRACT_UNIX, _SCOPE_SIGNAL = 1, 2

# Classic BPF, linux/filter.h and linux/seccomp.h.
_LOAD, _EQUAL, _SET, _AT_LEAST, _AND, _RETURN = 0x20, 0x15, 0x45, 0x35, 0x54, 0x06
_NR, _ARCH, _ARG0 = 0, 4, 16
_ALLOW, _FAIL, _KILL = 0x7FFF_0000, 0x0005_0000, 0x8000_0000
_EPERM, _ENOSYS, _EACCES = 1, 38, 13
_X32 = 0x4000_0000
_CLONE_NEW = 0x7E02_0000 | 0x80
"""All namespaces: mounts, cgroup, uts, ipc, user, pid, net; time."""
_FAMILIES = {"unix": 1, "inet": 2, "inet6": 10, "netlink": 16}
_ARCHITECTURES = {"x86_64": (0xC000_003E, 0), "aarch64": (0xC000_00B7, 1)}
_CLONE, _CLONE3, _SOCKET = (56, 220), (435, 435), (41, 198)
_FORBIDDEN = {
    # What looks into other processes, or at the machine.
    "ptrace": (101, 117),
    "process_vm_readv": (310, 270),
    "process_vm_writev": (311, 271),
    "kcmp": (312, 272),
    "pidfd_getfd": (438, 438),
    "perf_event_open": (298, 241),
    "syslog": (103, 116),
    # What changes namespaces and mounts.
    "unshare": (272, 97),
    "setns": (308, 268),
    "mount": (165, 40),
    "umount2": (166, 39),
    "pivot_root": (155, 41),
    "chroot": (161, 51),
    "open_tree": (428, 428),
    "move_mount": (429, 429),
    "fsopen": (430, 430),
    "fsconfig": (431, 431),
    "fsmount": (432, 432),
    "fspick": (433, 433),
    "mount_setattr": (442, 442),
    "open_by_handle_at": (304, 265),
    "name_to_handle_at": (303, 264),
    # Wide doors to the kernel that no service needs; io_uring also goes round this filter.
    "bpf": (321, 280),
    "userfaultfd": (323, 282),
    "io_uring_setup": (425, 425),
    "io_uring_enter": (426, 426),
    "io_uring_register": (427, 427),
    "add_key": (248, 217),
    "request_key": (249, 218),
    "keyctl": (250, 219),
    # What only root may anyway, and root's.
    "init_module": (175, 105),
    "finit_module": (313, 273),
    "delete_module": (176, 106),
    "kexec_load": (246, 104),
    "kexec_file_load": (320, 294),
    "reboot": (169, 142),
    "swapon": (167, 224),
    "swapoff": (168, 225),
    "acct": (163, 89),
    "quotactl": (179, 60),
    "settimeofday": (164, 170),
    "clock_settime": (227, 112),
    "adjtimex": (159, 171),
    "personality": (135, 92),
}
"""By name, the numbers on x86_64 and aarch64."""
_OF_OWNERS = {
    "chmod": (90, None),
    "fchmod": (91, 52),
    "fchmodat": (268, 53),
    "fchmodat2": (452, 452),
    "chown": (92, None),
    "lchown": (94, None),
    "fchown": (93, 55),
    "fchownat": (260, 54),
    "setxattr": (188, 5),
    "lsetxattr": (189, 6),
    "fsetxattr": (190, 7),
    "setxattrat": (463, 463),
    "removexattr": (197, 14),
    "lremovexattr": (198, 15),
    "fremovexattr": (199, 16),
    "removexattrat": (466, 466),
    "file_setattr": (469, 469),
}
"""What a file's owner may do to it wherever it is: no version of Landlock holds that."""
_TRUNCATE_CALL, _OPENAT2 = (76, 45), (437, 437)
_OPENS = (((2, None), 1), ((257, 56), 2))
"""open and openat, and which of their arguments has the flags."""
_ACCESS, _TO_NOTHING = 3, 0o1000
"""O_ACCMODE, O_TRUNC."""


def _checked(result: int, what: str) -> int:
    if result < 0:
        number = ctypes.get_errno()
        raise OSError(number, f"{what}: {os.strerror(number)}")
    return result


def landlock_version() -> int:
    """0: the kernel has none, or it is switched off."""
    return max(0, int(_LIBC.syscall(_CREATE, None, ctypes.c_size_t(0), 1)))


def own_mounts() -> None:
    """Mounts, and shared memory, that nobody else sees; and of processes it sees its own only."""
    _checked(_LIBC.unshare(_CLONE_NEWNS | _CLONE_NEWIPC), "mounts of its own")
    _checked(_LIBC.mount(b"none", b"/", None, ctypes.c_ulong(_MS_REC | _MS_PRIVATE), None), "mounts of its own")
    with contextlib.suppress(OSError):  # in a container, where some of /proc is covered, it is not given anew
        _mount("proc", "/proc", "proc", _MS_NOSUID | _MS_NODEV | _MS_NOEXEC, "hidepid=2")


def _mount(source: str, target: str, kind: str | None, flags: int, options: str | None = None) -> None:
    _checked(
        _LIBC.mount(
            source.encode(),
            target.encode(),
            kind and kind.encode(),
            ctypes.c_ulong(flags),
            options and options.encode(),
        ),
        f"mount on {target}",
    )


def cover(covers: list[str], read: list[str], write: list[str]) -> None:
    """Put empty folders over some, and into these what of them may be used, where it was."""
    kept = {}
    for path in sorted({*read, *write}, key=len):
        real = os.path.realpath(path)
        if any(real.startswith(f"{folder}/") for folder in covers) and os.path.exists(real):
            kept[real] = os.open(real, os.O_PATH | os.O_CLOEXEC)
    writable = {os.path.realpath(path) for path in write}
    for folder in covers:
        options = f"mode=1777,size={_SCRATCH_SIZE}" if folder in _SCRATCH else "mode=0755,size=1m"
        _mount("none", folder, "tmpfs", _MS_NOSUID | _MS_NODEV, options)
    for path, file in kept.items():
        source = f"/proc/self/fd/{file}"
        if not os.path.lexists(path):
            if os.path.isdir(source):
                os.makedirs(path)
            else:
                os.makedirs(os.path.dirname(path), exist_ok=True)
                os.close(os.open(path, os.O_CREAT | os.O_EXCL, 0o600))
        _mount(source, path, None, _MS_BIND | _MS_REC)
        if path not in writable:
            _mount("none", path, None, _MS_BIND | _MS_REMOUNT | _MS_RDONLY | _MS_NOSUID | _MS_NODEV)
        os.close(file)
    for folder in covers:
        if folder not in _SCRATCH:
            _mount("none", folder, None, _MS_BIND | _MS_REMOUNT | _MS_RDONLY | _MS_NOSUID | _MS_NODEV)


def drop_capabilities() -> None:
    """So that no program that it starts gets any back, root's neither."""
    for number in range(_CAPABILITIES):
        if _LIBC.prctl(_PR_CAPBSET_DROP, number, 0, 0, 0) and ctypes.get_errno() == 1:
            return  # not root: there is nothing to drop


def become(user: int, groups: list[int]) -> None:
    """Another user, with none of this one's groups."""
    os.setgroups(groups)
    os.setresgid(user, user, user)
    os.setresuid(user, user, user)


def end_all(user: int) -> None:
    """Kill all processes of a user. None of them can kill this one first: it asks as that user, and is another."""
    os.setgroups([])
    os.setresgid(_ENDER, _ENDER, _ENDER)
    os.setresuid(_ENDER, user, _ENDER)
    try:
        os.kill(-1, signal.SIGKILL)  # never this one
    except ProcessLookupError:
        return  # there is none


def landlock(version: int, read: list[str], write: list[str]) -> None:
    """Let only these folders and files be reached."""
    files = _FIRST | (_REFER if version >= 2 else 0) | (_TRUNCATE if version >= 3 else 0)
    files |= _IOCTL_DEV if version >= 5 else 0
    scoped = (_SCOPE_ABSTRACT_UNIX | _SCOPE_SIGNAL) if version >= 6 else 0
    attributes = struct.pack(
        "QQQ", files, 0, scoped
    )  # no port is held[: 24 if version >= 6 else 16 if version >= 4 else 8]
    rules = _checked(
        _LIBC.syscall(_CREATE, ctypes.c_char_p(attributes), ctypes.c_size_t(len(attributes)), 0), "Landlock"
    )
    for paths, rights in ((read, _READ), (write, files)):
        for path in paths:
            try:
                file = os.open(path, os.O_PATH | os.O_CLOEXEC)
            except OSError:
                continue  # not there, or not for this user
            granted = rights & files if os.path.isdir(path) else rights & files & _OF_FILES
            rule = struct.pack("=Qi", granted, file)
            _checked(_LIBC.syscall(_ADD_RULE, rules, _RULE_PATH, ctypes.c_char_p(rule), 0), f"Landlock of {path}")
            os.close(file)
    _checked(_LIBC.syscall(_RESTRICT, rules, 0), "Landlock")
    os.close(rules)


def seccomp(families: list[str], *, owner: bool = False, empties: bool = False) -> None:
    """Take away calls of the kernel, and sockets of all other families; inherited by all that it starts.

    Args:
        families: Of sockets.
        owner: It is the user whose files it must not change.
        empties: Landlock is too old to keep it from making files empty that it may not write.
    """
    architecture, column = _ARCHITECTURES[platform.machine()]
    program = [(_LOAD, 0, 0, _ARCH), (_EQUAL, 1, 0, architecture), (_RETURN, 0, 0, _KILL), (_LOAD, 0, 0, _NR)]
    program += [(_AT_LEAST, 0, 1, _X32), (_RETURN, 0, 0, _FAIL | _ENOSYS)]
    forbidden = [*_FORBIDDEN.values(), *(_OF_OWNERS.values() if owner else ()), *([_TRUNCATE_CALL] if empties else ())]
    for number in sorted(number for numbers in forbidden if (number := numbers[column]) is not None):
        program += [(_EQUAL, 0, 1, number), (_RETURN, 0, 0, _FAIL | _EPERM)]
    if empties:
        program += _no_emptying_open(column)
    # The C library asks clone3 first, whose flags are out of a filter's sight, and then clone.
    program += [(_EQUAL, 0, 1, _CLONE3[column]), (_RETURN, 0, 0, _FAIL | _ENOSYS)]
    program += [(_EQUAL, 0, 4, _CLONE[column]), (_LOAD, 0, 0, _ARG0)]
    program += [(_SET, 0, 1, _CLONE_NEW), (_RETURN, 0, 0, _FAIL | _EPERM), (_RETURN, 0, 0, _ALLOW)]
    known = [_FAMILIES[family] for family in families]
    program += [(_EQUAL, 0, len(known) + 2, _SOCKET[column]), (_LOAD, 0, 0, _ARG0)]
    program += [(_EQUAL, len(known) - at, 0, family) for at, family in enumerate(known)]
    program += [(_RETURN, 0, 0, _FAIL | _EACCES), (_RETURN, 0, 0, _ALLOW)]
    packed = b"".join(struct.pack("=HBBI", *row) for row in program)
    buffer = ctypes.create_string_buffer(packed, len(packed))
    head = struct.pack("@HP", len(program), ctypes.addressof(buffer))
    _checked(_LIBC.prctl(_PR_SET_SECCOMP, _SECCOMP_MODE_FILTER, ctypes.c_char_p(head), 0, 0), "seccomp")


def _no_emptying_open(column: int) -> list[tuple[int, int, int, int]]:
    """Refuses O_TRUNC without a right to write: the kernel makes the file empty all the same.

    The fourth way to open, that is neither reading nor writing (3), even asks Landlock for no right at all.
    """
    program = [(_EQUAL, 0, 1, _OPENAT2[column]), (_RETURN, 0, 0, _FAIL | _ENOSYS)]  # its flags are out of sight
    for numbers, at in _OPENS:
        if (number := numbers[column]) is not None:
            program += [(_EQUAL, 0, 6, number), (_LOAD, 0, 0, _ARG0 + 8 * at), (_AND, 0, 0, _ACCESS | _TO_NOTHING)]
            program += [(_EQUAL, 1, 0, _TO_NOTHING), (_EQUAL, 0, 1, _ACCESS | _TO_NOTHING)]
            program += [(_RETURN, 0, 0, _FAIL | _EACCES), (_RETURN, 0, 0, _ALLOW)]
    return program


def probe() -> dict[str, Any]:
    """What of all this the machine has; undone by the end of this process."""
    has: dict[str, Any] = {"landlock": landlock_version(), "seccomp": False, "user": False, "hidden": False}
    try:
        if os.geteuid() == 0:
            own_mounts()
            _mount("none", "/tmp", "tmpfs", _MS_NOSUID | _MS_NODEV)  # noqa: S108
            become(65_534, [])
            has["user"] = True
            # Before Linux 5.8 every mount of /proc has the options of the first.
            has["hidden"] = not os.path.exists(f"/proc/{os.getppid()}")
    except OSError as error:
        has["why"] = str(error)
    if platform.machine() in _ARCHITECTURES:
        _LIBC.prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0)
        try:
            seccomp(["inet"])
            has["seccomp"] = True
        except OSError:
            pass
    return has


def main() -> None:
    """Do it; returns only where no service is to be run."""
    asked = json.loads(sys.argv[1])
    if asked.get("probe"):
        sys.stdout.write(json.dumps(probe()))
        return
    if "end" in asked:
        end_all(asked["end"])
        return
    read, write, user = asked["read"], asked["write"], asked["user"]
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))  # a dump of its memory would hold the session's key
    if user is not None:
        own_mounts()
        ours = os.umask(0o022)  # under the covers, the service passes through folders that are made now, and root's
        cover(asked["cover"], read, write)
        os.umask(ours)
        os.chdir(asked["folder"])
        write += [folder for folder in asked["cover"] if folder in _SCRATCH]
    drop_capabilities()
    if user is not None:
        resource.setrlimit(resource.RLIMIT_NPROC, (asked["pids"],) * 2)  # of a user: all of the instance's
        become(user, asked["groups"])
    _checked(_LIBC.prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0), "no new privileges")
    if asked["landlock"]:
        landlock(asked["landlock"], read, write)
    if asked["seccomp"]:
        seccomp(asked["families"], owner=user is None, empties=user is None and asked["landlock"] < HOLDS_TRUNCATE)
    program = asked["command"][0]
    try:
        os.execv(program, asked["command"])  # noqa: S606 (no shell is wanted)
    except OSError as error:  # it does not name it; often a link that leads through a folder that is covered
        raise OSError(error.errno, f"{program}: {error.strerror}; the service does not see it") from error


if __name__ == "__main__":
    try:
        main()
    except OSError as error:
        sys.exit(f"the service cannot be confined: {error}")
