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
_STOPS_S = 1.0
"""For the kernel to stop all its threads."""


def stop(container: str, first: object, proc: Path = PROC) -> bool:
    """Stop that of a container that runs. `let_go_on` comes next, whatever this says.

    Args:
        container: Its id.
        first: Number of its first process, as the engine says it.
        proc: Where the kernel shows processes.

    Returns:
        Whether that number is this container's until then. It is not where the engine has no such process, one of
        another user, or one that is hidden; and where the container has ended.
    """
    try:
        shim = int(_stat(proc / str(first))[1])
        if not _signal(shim, container, signal.SIGSTOP, proc) or not _has_stopped(proc / str(shim)):
            return False
        # Who is in its group is the container's own: so that number was, too, when it was asked whose child it is.
        group = (proc / str(first) / "cgroup").read_text()
        state, parent, *_ = _stat(proc / str(first))
    except (OSError, ValueError, IndexError):
        return False
    return container in group and state not in _ENDED and int(parent) == shim


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
