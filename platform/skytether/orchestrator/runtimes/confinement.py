"""How an instance of a process site is held: what it may reach, and what this machine has to hold it with.

Each may read the system's programs and libraries, Python with what the orchestrator imports, and what the options of
its site add; it may write into its two folders alone. Landlock says so where the kernel has it; where the orchestrator
is root, each instance is another user besides, and folders with secrets in them are covered. ``confine`` does it.
"""

from __future__ import annotations

import functools
import json
import os
import stat
import subprocess
import sys
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from . import confine
from .base import RuntimeFailure

_READ = (
    *("/usr", "/bin", "/sbin", "/lib", "/lib32", "/lib64", "/libx32", "/opt/ros", "/proc", "/sys"),
    *("/etc/alternatives", "/etc/fonts", "/etc/gai.conf", "/etc/group", "/etc/host.conf", "/etc/hosts"),
    *("/etc/ld.so.cache", "/etc/ld.so.conf", "/etc/ld.so.conf.d", "/etc/localtime", "/etc/mime.types"),
    *("/etc/nsswitch.conf", "/etc/os-release", "/etc/passwd", "/etc/protocols", "/etc/python3", "/etc/resolv.conf"),
    *("/etc/ros", "/etc/services", "/etc/ssl/certs", "/etc/ssl/openssl.cnf", "/etc/timezone"),
)
"""Not all of /etc, which holds other programs' secrets, nor /var and /home."""
_WRITE = ("/dev/null", "/dev/zero", "/dev/full", "/dev/random", "/dev/urandom")
COVERED = ("/tmp", "/var/tmp", "/dev/shm", "/run")  # noqa: S108
"""Where other programs leave files and sockets for everybody; the engine's socket is in /run."""
_PROBE_S = 30


@dataclass(frozen=True, slots=True)
class Machine:
    """What there is to hold an instance with."""

    landlock: int
    """Its version; 0: there is none."""
    seccomp: bool
    user: bool
    """Each instance can be another user, with mounts of its own."""
    why: str = ""
    """Why it cannot."""
    hidden: bool = False
    """An instance sees no processes but its own."""

    def holds(self) -> tuple[str, ...]:
        """In words for people."""
        landlock = f"Landlock {self.landlock}"
        users = ("own user", self.user), ("own mounts", self.user), ("own processes", self.hidden)
        found = *users, (landlock, self.landlock), ("seccomp", self.seccomp)
        return tuple(name for name, there in found if there)

    def lacks(self) -> str:
        """What the orchestrator's files and other programs' sockets are not protected from, and why; empty: nothing."""
        if not self.landlock and not self.user:
            return "instances can read all of the orchestrator's secrets: the kernel has no Landlock" + (
                f", and there are no users of their own ({self.why})" if self.why else ""
            )
        if not self.seccomp and not self.user:
            empty = "" if self.landlock >= confine.HOLDS_TRUNCATE else "empty the orchestrator's files, "
            return (
                f"instances can {empty}change the modes of the orchestrator's files, and reach sockets of other "
                "programs such as a Docker engine's: the kernel has no seccomp, or the processor is another one than "
                "x86_64 and aarch64"
            )
        return ""


@functools.cache
def this_machine() -> Machine:
    """Tried once, by a process that ends."""
    try:
        has = _answer("-S", confine.__file__, '{"probe": true}')
    except (OSError, ValueError, subprocess.SubprocessError) as error:
        return Machine(0, seccomp=False, user=False, why=str(error))
    return Machine(has["landlock"], has["seccomp"], has["user"], has.get("why", ""), has["hidden"])


def readable(more: Collection[Path]) -> list[str]:
    """What every instance of a site may read: the system's, Python's, what Python imports, what the site adds.

    Raises:
        RuntimeFailure: Python does not say what it imports from.
    """
    python = [sys.prefix, sys.base_prefix, os.path.realpath(sys.executable)]
    return sorted({*_READ, *python, *_imported(), *map(str, more)})


@functools.cache
def _imported() -> tuple[str, ...]:
    """Where services import from, asked of a Python that is started as they are.

    This process's own ``sys.path`` has more: the folder that the orchestrator was started in, which is nobody's code
    and would stand, closed to the services, before what is in it; PYTHONPATH; a home's packages.
    """
    try:
        paths = _answer("-c", "import json, sys; print(json.dumps(sys.path))")
    except (OSError, ValueError, subprocess.SubprocessError) as error:
        raise RuntimeFailure(f"{sys.executable} does not say where it imports from: {error}") from error
    return tuple(path for path in paths if os.path.isabs(path))


def _answer(*arguments: str) -> Any:
    """What a Python that is started as services are prints, as JSON.

    The time-out is not `subprocess`'s: that sleeps, which fails now and then under a clock that is faked (libfaketime).

    Raises:
        OSError: It cannot be started.
        ValueError: That is no JSON.
        SubprocessError: It failed, or took too long.
    """
    command = ["timeout", str(_PROBE_S), sys.executable, "-I", *arguments]
    return json.loads(subprocess.check_output(command, stderr=subprocess.DEVNULL))


def opened(secret: Path, read: Sequence[str]) -> str | None:
    """Which of these paths holds a folder with secrets; None: none."""
    real = secret.resolve()
    return next((path for path in read if real.is_relative_to(Path(path).resolve())), None)


def launch_file(path: str, reachable: Sequence[str], closed: Sequence[Path]) -> str | None:
    """What a service must be allowed to read to read its launch file; None: nothing more, it is ``reachable``.

    A manifest names it, so it opens neither folders nor what others on this machine may not read.

    Raises:
        RuntimeFailure: It is no such file, or is in one of the folders that are ``closed``.
    """
    try:
        real = os.path.realpath(path)
        if any(Path(real).is_relative_to(os.path.realpath(held)) for held in reachable):
            return None
        mode = os.stat(real).st_mode
    except (OSError, ValueError) as error:  # ValueError: a zero byte in it
        raise RuntimeFailure(f"launch: {path} cannot be read: {error}") from None
    if not stat.S_ISREG(mode) or not mode & stat.S_IROTH:
        raise RuntimeFailure(
            f"launch: {path} is no file that every user may read: let them (chmod o+r), or add it to the site's "
            "'readable'"
        )
    if any(Path(real).is_relative_to(folder.resolve()) for folder in closed):
        raise RuntimeFailure(f"launch: {path} is in the orchestrator's state: keep launch files elsewhere")
    return real


def covers(paths: Sequence[str]) -> list[str]:
    """Folders to cover: those of other programs, and the outermost above each path that others may not pass through."""
    found = [folder for folder in COVERED if os.path.isdir(folder) and not os.path.islink(folder)]
    for path in paths:
        if any(os.path.realpath(path).startswith(f"{folder}/") for folder in found):
            continue
        for folder in reversed(Path(os.path.realpath(path)).parents):
            try:
                passable = folder.stat().st_mode & stat.S_IXOTH
            except OSError:
                break
            if not passable and folder != Path("/"):
                found.append(str(folder))
                break
    return found


def confined(
    command: Sequence[str],
    machine: Machine,
    read: Sequence[str],
    write: Sequence[str],
    user: int | None,
    groups: Sequence[int],
    pids: int,
) -> list[str]:
    """The command that gives up rights, then becomes this one.

    Args:
        command: With the absolute path of the program.
        machine: What it has.
        read: May be read, and run.
        write: May be written, too; the last one is where it starts.
        user: Who it becomes; None: nobody else.
        groups: Of that user, by number.
        pids: Processes and threads that a user of its own may have at most.
    """
    asked = {
        "command": list(command),
        "read": list(read),
        "write": [*_WRITE, *write],
        "folder": write[-1],
        "cover": covers([*read, *write]) if user is not None else [],
        "user": user,
        "groups": list(groups),
        "pids": pids,
        "landlock": machine.landlock,
        "seccomp": machine.seccomp,
        # Without mounts of its own, every socket in the file system that the orchestrator's user may use is in its
        # reach, that of a Docker engine among them; Landlock does not mind those.
        "families": ["inet", "inet6", "netlink", *(["unix"] if user is not None else [])],
    }
    return [sys.executable, "-I", "-S", confine.__file__, json.dumps(asked)]
