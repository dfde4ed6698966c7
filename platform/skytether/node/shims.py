"""The process of containerd beside a container, by which its engine hears that it has ended.

While that is stopped, nobody hears it: the container's first process stays as it ended, a zombie, and the kernel gives
its number to nobody else. An engine that names a network by that number then finds this one's, or none.
"""

from __future__ import annotations

import contextlib
import os
import signal
import time
from pathlib import Path

PROC = Path("/proc")
_NAME = "containerd-shim"
_ENDED = "ZX"
_STOPS_S = 0.2
"""For the kernel to stop all its threads."""


def stop(container: str, first: object, proc: Path = PROC) -> bool | None:
    """Stop that of a container that runs. `let_go_on` comes next, whatever this says.

    Args:
        container: Its id.
        first: Number of its first process, as the engine says it.
        proc: Where the kernel shows processes.

    Returns:
        Whether that number is this container's until then: not if it has ended. None: nobody can see to that, for
        processes are hidden from this one, or the engine has no such process, or it is another user's.
    """
    if not (proc / "1" / "stat").exists():
        return None
    try:
        if not _is_first(container, proc / str(first)):
            return False
        shim = int(_stat(proc / str(first))[1])
        if not _signal(shim, container, signal.SIGSTOP, proc):
            return None
        # Who is in its group is the container's own: so that number was, too, when it was asked whose child it is.
        return (
            _has_stopped(proc / str(shim))
            and _is_first(container, proc / str(first))
            and int(_stat(proc / str(first))[1]) == shim
        )
    except PermissionError:
        return None
    except (OSError, ValueError, IndexError):
        return False


def let_go_on(container: str, proc: Path = PROC) -> None:
    """What `stop` did is undone, whatever program did it. May be called again."""
    for folder in proc.iterdir():
        if folder.name.isdecimal():
            with contextlib.suppress(OSError):
                _signal(int(folder.name), container, signal.SIGCONT, proc)


def _signal(process: int, container: str, number: signal.Signals, proc: Path) -> bool:
    """Whether it is the shim of that container, and was sent that."""
    words = (proc / str(process) / "cmdline").read_bytes().split(b"\0")
    if not _is_shim(words, container):
        return False
    handle = os.pidfd_open(process)
    try:
        words = (proc / str(process) / "cmdline").read_bytes().split(b"\0")
        if not _is_shim(words, container):  # another one has that number now
            return False
        signal.pidfd_send_signal(handle, number)
    finally:
        os.close(handle)
    return True


def _is_shim(words: list[bytes], container: str) -> bool:
    return Path(os.fsdecode(words[0])).name.startswith(_NAME) and container.encode() in words


def _is_first(container: str, folder: Path) -> bool:
    """Whether a process is of that container, and has not ended: of one that has, the group may be another."""
    return container in (folder / "cgroup").read_text() and _stat(folder)[0] not in _ENDED


def _has_stopped(folder: Path) -> bool:
    """Whether each of its threads has."""
    until = time.monotonic() + _STOPS_S
    while any(_stat(thread)[0] != "T" for thread in (folder / "task").iterdir()):
        if time.monotonic() > until:
            return False
        time.sleep(0.001)
    return True


def _stat(folder: Path) -> list[str]:
    """Its state, its parent, and more: what comes after its name, in which anything may be (proc(5))."""
    return (folder / "stat").read_text(errors="replace").rpartition(")")[2].split()
