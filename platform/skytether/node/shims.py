"""The process of containerd beside a container, by which its engine hears that it has ended.

While that is stopped, nobody hears it: the container's first process stays as it ended, a zombie, and the kernel gives
its number to nobody else. An engine that names a network by that number then finds this one's, or none.
"""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Collection, Iterator
from pathlib import Path

PROC = Path("/proc")
_NAME = "containerd-shim"
_LONGEST = 4096
"""Bytes of a command line: of a process that sees to that it is as long as its memory."""
_ENDED = "ZX"
_STOPS_S = 0.2
"""For the kernel to stop all its threads."""


def stop(container: str, first: object, proc: Path = PROC) -> bool | None:
    """Stop that of a container that runs. `resume` comes next, whatever this says.

    Args:
        container: Its id.
        first: Number of its first process, as the engine says it.
        proc: Where the kernel shows processes.

    Returns:
        Whether that number is this container's until then: not if it has ended, or if all that takes too long. None:
        nobody can see to that, for processes are hidden from this one, or the engine has no such process, or it is
        another user's.
    """
    try:
        if not (proc / "1" / "stat").exists():
            return None
        if not _is_first(container, proc / str(first)):
            return False
        shim = int(_stat(proc / str(first))[1])
        if not _is_shim(proc / str(shim), container):
            return None
        os.kill(shim, signal.SIGSTOP)
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


def resume(container: str, proc: Path = PROC) -> bool:
    """What `stop` did is undone, whatever program did it. May be called again.

    Returns:
        Whether it was stopped.

    Raises:
        OSError: It cannot be found out now, for want of open files, say.
    """
    stopped = False
    for number in _shims_of((container,), proc):
        with contextlib.suppress(FileNotFoundError, ProcessLookupError, PermissionError):
            stopped = _stat(proc / str(number))[0] == "T" or stopped
            os.kill(number, signal.SIGCONT)
    return stopped


def is_any(containers: Collection[str], proc: Path = PROC) -> bool:
    """Whether one of these has that process: from then on its engine asks nothing more of another to start it.

    Raises:
        OSError: As `resume`.
    """
    return any(_shims_of(containers, proc))


def _shims_of(containers: Collection[str], proc: Path) -> Iterator[int]:
    for folder in proc.iterdir():
        if folder.name.isdecimal():
            with contextlib.suppress(FileNotFoundError, ProcessLookupError, PermissionError):
                if _is_shim(folder, *containers) and _is_of_machine(folder):
                    yield int(folder.name)


def _is_shim(folder: Path, *containers: str) -> bool:
    """Whether that process is of one of these containers."""
    with (folder / "cmdline").open("rb") as file:
        words = file.read(_LONGEST).split(b"\0")
    named = Path(os.fsdecode(words[0])).name.startswith(_NAME)
    return named and any(container.encode() in words for container in containers)


def _is_of_machine(folder: Path) -> bool:
    """Whether it is in no container, where anybody can have it called as he likes: it has one number only, then."""
    lines = (folder / "status").read_text(errors="replace").splitlines()
    return any(len(line.split()) == 2 for line in lines if line.startswith("NSpid:"))


def _is_first(container: str, folder: Path) -> bool:
    """Whether a process is of that container, and has not ended: of one that has, the group may be another."""
    return container in (folder / "cgroup").read_text() and _stat(folder)[0] not in _ENDED


def _has_stopped(folder: Path) -> bool:
    """Whether each of its threads has."""
    until = time.monotonic() + _STOPS_S
    while not all(map(_is_still, (folder / "task").iterdir())):
        if time.monotonic() > until:
            return False
        time.sleep(0.001)
    return True


def _is_still(thread: Path) -> bool:
    try:
        return _stat(thread)[0] == "T"
    except (FileNotFoundError, ProcessLookupError):  # it has ended
        return True


def _stat(folder: Path) -> list[str]:
    """Its state, its parent, and more: what comes after its name, in which anything may be (proc(5))."""
    return (folder / "stat").read_text(errors="replace").rpartition(")")[2].split()
