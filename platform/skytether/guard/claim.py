"""The folder of the gate's sockets belongs to one guard, for as long as people can reach that guard through it."""

from __future__ import annotations

import fcntl
import os
import threading
import time

from .folder import objection

LOCK_FILE = "lock"
_LOOK_S = 0.5


class ClaimError(Exception):
    """The folder cannot be had; the text says why and what to do."""


class Claim:
    """A lock on a file in the folder, and a thread that sees whether the folder still leads here.

    A folder that is removed takes the sockets along: nobody can stop this guard any more, and another one can be
    started for the same wheels. So a guard that has lost its folder has to brake and end.

    Args:
        folder: It is made if it is not there.

    Raises:
        ClaimError: Another guard has it, or it cannot be made.
    """

    def __init__(self, folder: str) -> None:
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
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(self._lock)
            raise ClaimError(f"another gate runs in {folder}; end it, or name another safety.folder") from error
        self._files = {path: _identity(os.fstat(self._lock))}

    def add(self, path: str) -> None:
        """One of this guard's sockets, which has to stay where it is."""
        self._files[path] = _identity(os.stat(path))

    def start(self) -> None:
        """Look from now on, in a thread of its own: a disk that hangs holds up nothing else."""
        threading.Thread(target=self._run, name="claim", daemon=True).start()

    def look(self) -> None:
        """Look once."""
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
            self.look()


def _identity(status: os.stat_result) -> tuple[int, int]:
    return status.st_dev, status.st_ino
