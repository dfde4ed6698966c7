"""Which containers have processes, as the kernel says it.

runc takes a container for ended as soon as the first thread of its first process has: others of that process may go on,
and with them whatever folders they have open, though an engine says that nothing runs, or that there is no container.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
from pathlib import Path

ROOT, PROC = Path("/sys/fs/cgroup"), Path("/proc")
_HIERARCHIES = ("pids", "memory", "systemd", ".")
"""Where a container's group may be; the last is the only one of version 2."""
_NAME = re.compile(r"(docker-)?(?:[a-z]+-)?([0-9a-f]{64})(?:\.scope)?")
_PARENTS = {"docker", ""}
"""Of Docker's own, where systemd does not make them."""


class Cgroups:
    """The groups of all containers, as they were when this was made.

    Args:
        root: Of the file system.

    Raises:
        OSError: They cannot be listed now, for want of open files, say.
    """

    def __init__(self, root: Path = ROOT) -> None:
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

    def end(self, container: str) -> None:
        """End its processes, those that this program may; may be called again."""
        for folder in self._folders.get(container, {}):
            with contextlib.suppress(OSError):
                for number in (folder / "cgroup.procs").read_text().split():
                    with contextlib.suppress(OSError):  # it has just ended; or it is another user's
                        if container.encode() in (PROC / number / "cgroup").read_bytes():  # it is the same one still
                            os.kill(int(number), signal.SIGKILL)

    def of_docker(self) -> set[str]:
        """Containers that an engine of Docker made, or may have."""
        return {container for container, folders in self._folders.items() if any(folders.values())}


def _found(top: Path) -> dict[str, dict[Path, bool]]:
    """Containers, and their groups: of each, whether it may be of Docker."""
    found: dict[str, dict[Path, bool]] = {}
    for folder, _, _ in os.walk(top, onerror=_must_be_listed):
        path = Path(folder)
        if named := _NAME.fullmatch(path.name):
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
