"""The folder of the gate's sockets belongs to one guard, for as long as people can reach that guard through it."""

from __future__ import annotations

import fcntl
import os
import socket
import threading
import time

from .folder import objection, peer_process
from .protocol import STOP_SOCKET

LOCK_FILE = "lock"
_LOOK_S = 0.5
_ENDS_S = 10.0
"""For what is left of the guard before: it waits for a disk, or its gate and writer brake."""
_AGAIN_S = 0.05


class ClaimError(Exception):
    """The folder cannot be had; the text says why and what to do."""


class Claim:
    """A lock on a file in the folder, and a thread that sees whether the folder still leads here.

    A folder that is removed takes the sockets along: nobody can stop this guard any more, and another one can be
    started for the same wheels. So a guard that has lost its folder has to brake and end.

    Args:
        folder: It is made if it is not there.
        patience_s: With a guard that ends, and with the gate and the writer of one that is gone [s].

    Raises:
        ClaimError: Another guard has it, or it cannot be made.
    """

    def __init__(self, folder: str, patience_s: float = _ENDS_S) -> None:
        self.lost = ""
        """What is not there any more, or another one; empty: all is in its place."""
        path = os.path.join(folder, LOCK_FILE)
        before = os.umask(0o022)  # nobody else may write into it, whatever this process was started with
        try:
            os.makedirs(folder, exist_ok=True)
            if why := objection(folder):
                raise ClaimError(f"cannot trust the folder {folder} for the gate's sockets: {why}")
            self._lock = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
        except OSError as error:
            raise ClaimError(f"cannot use the folder {folder} for the gate's sockets: {error.strerror}") from error
        finally:
            os.umask(before)
        try:
            self._acquire(folder, time.monotonic() + patience_s)
        except ClaimError:
            os.close(self._lock)  # else the number stays taken for as long as whoever asked lives
            raise
        self._files = {path: _identity(os.fstat(self._lock))}

    def _acquire(self, folder: str, end: float) -> None:
        try:
            while not _locked(self._lock, fcntl.LOCK_EX):
                if guarded(folder) or time.monotonic() > end:
                    raise ClaimError(f"another gate runs in {folder}; end it, or name another safety.folder")
                time.sleep(_AGAIN_S)
        except OSError as error:
            raise ClaimError(f"cannot lock the folder {folder}: {error.strerror}") from error

    def add(self, path: str) -> None:
        """One of this guard's sockets, which has to stay where it is."""
        self._files[path] = _identity(os.stat(path))

    def start(self) -> None:
        """Look from now on, in a thread of its own: a disk that hangs holds up nothing else."""
        threading.Thread(target=self._run, name="claim", daemon=True).start()

    def check(self) -> None:
        """Look once whether the files are still ours."""
        for path, identity in self._files.items():
            try:
                there = _identity(os.stat(path)) == identity
            except (FileNotFoundError, NotADirectoryError):
                there = False
            except OSError:  # a disk that cannot say: that is no loss
                continue
            if not there:
                self.lost = path

    def _run(self) -> None:
        while not self.lost:
            time.sleep(_LOOK_S)
            self.check()


class Heir:
    """A gate or a writer whose guard is gone: it stops the wheels, and meanwhile no other guard can have the folder.

    One that stood still until another guard was there has nothing to say any more.

    Args:
        folder: Of the guard, which has it.
        guard: The socket to the guard, which has made it.
    """

    def __init__(self, folder: str, guard: socket.socket) -> None:
        self._guard = peer_process(guard)
        try:  # now, as no disk is waited for later
            path = os.path.join(folder, LOCK_FILE)
            self._lock: int | None = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
        except OSError:
            self._lock = None

    def may(self) -> bool:
        """Whether it may tell the wheels something. Does not wait."""
        if os.getppid() == self._guard:
            return True  # the guard ends in order, and still has the folder
        try:
            return self._lock is None or _locked(self._lock, fcntl.LOCK_SH)
        except OSError:  # a file system without locks: then no other guard has one either
            return True

    def close(self) -> None:
        """Let go of the folder."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None


def guarded(folder: str) -> bool:
    """Whether a guard listens in a folder, even if it hangs. Does not wait."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as link:
        link.setblocking(False)
        try:
            link.connect(os.path.join(folder, STOP_SOCKET))
        except (BlockingIOError, PermissionError):  # its queue is full, or it is another user's
            return True
        except OSError:
            return False
        return True


def _locked(file: int, how: int) -> bool:
    """Whether a lock is had, or nobody else has it."""
    try:
        fcntl.flock(file, how | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _identity(status: os.stat_result) -> tuple[int, int]:
    return status.st_dev, status.st_ino
