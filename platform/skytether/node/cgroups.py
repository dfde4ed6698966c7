"""Which containers have processes, as the kernel says it.

runc takes a container for ended as soon as the first thread of its first process has: others of that process may go on,
and with them whatever folders they have open, though an engine says that nothing runs, or that there is no container.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

ROOT, PROC = Path("/sys/fs/cgroup"), Path("/proc")
_HIERARCHIES = ("pids", "memory", "systemd", ".")
"""Where a container's group may be; the last is the only one of version 2."""
_NAME = re.compile(r"(docker-)?(?:[a-z]+-)?([0-9a-f]{64})(?:\.scope)?")
_SHIM = "containerd-shim"
_PARENTS = {"docker", ""}
"""Of Docker's own, where systemd does not make them."""


class Cgroups:
    """The groups of all containers, as they were when this was made.

    What is in a container's group belongs to it: a container of an engine that runs in there, for one.

    Args:
        root: Of the file system.
        proc: Of the one with all processes.

    Raises:
        OSError: They cannot be listed now, for want of open files, say.
    """

    def __init__(self, root: Path = ROOT, proc: Path = PROC) -> None:
        self._proc = proc
        tops = (root / one for one in _HIERARCHIES)
        top = next((one for one in tops if (one / "cgroup.procs").exists()), None)
        self._folders = _found(top) if top else {}

    def go_on(self, container: str) -> bool:
        """Whether it has processes now."""
        return any(map(_has_process, self._folders.get(container, {})))

    def kill(self, container: str) -> str:
        """The command that ends its processes."""
        groups = " ".join(f"{folder}/cgroup.procs" for folder in self._folders.get(container, {}))
        return f"kill -9 $(cat {groups})"

    def is_kept(self, container: str) -> bool:
        """Whether it runs as one does whose engine knows it: one that ours does not know is another engine's then.

        Its first process lives, as the child of the program that an engine has for each of its containers, and that is
        in no container's group. What goes on in spite of an engine has a first process whose first thread has ended.
        """
        return any(
            self._is_kept(container, pid) for folder in self._folders.get(container, {}) for pid in _pids(folder)
        )

    def _is_kept(self, container: str, pid: str) -> bool:
        try:
            said = _said((self._proc / pid / "status").read_text())
            if said["NSpid"].split()[-1] != "1" or said["State"][0] in "ZX":
                return False
            parent = self._proc / said["PPid"]
            program, *arguments = (parent / "cmdline").read_text().split("\0")
            inside = any(_NAME.fullmatch(part) for part in re.split("[/\n]", (parent / "cgroup").read_text()))
        except (OSError, LookupError, ValueError):  # it has ended, or is not shown
            return False
        return Path(program).name.startswith(_SHIM) and any(container in one for one in arguments) and not inside

    def of_docker(self) -> set[str]:
        """Containers that an engine of Docker made, or may have."""
        return {container for container, folders in self._folders.items() if any(folders.values())}


def _found(top: Path) -> dict[str, dict[Path, bool]]:
    """Containers, and their groups: of each, whether it may be of Docker."""
    found: dict[str, dict[Path, bool]] = {}
    for folder, below, _ in os.walk(top, onerror=_must_be_listed):
        path = Path(folder)
        if named := _NAME.fullmatch(path.name):
            below.clear()
            parent = "" if path.parent == top else path.parent.name
            found.setdefault(named[2], {})[path] = bool(named[1]) or (path.name == named[2] and parent in _PARENTS)
    return found


def _must_be_listed(error: OSError) -> None:
    if not isinstance(error, FileNotFoundError):  # it has ended meanwhile
        raise error


def _has_process(folder: Path) -> bool:
    """Threads count: that of the first is a zombie then."""
    try:
        events = folder / "cgroup.events"
        if events.exists():
            return "populated 1" in events.read_text()
        return bool((folder / "tasks").read_text())
    except FileNotFoundError:
        return False
    except OSError:
        return True


def _pids(folder: Path) -> list[str]:
    try:
        return (folder / "cgroup.procs").read_text().split()
    except OSError:
        return []


def _said(status: str) -> dict[str, str]:
    """Of a process, as the kernel tells it, a line each."""
    lines = (line.partition(":") for line in status.splitlines())
    return {key: value.strip() for key, _, value in lines}
