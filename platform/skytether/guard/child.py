"""A process that the guard starts and watches: the gate, or the writer to a graph."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import threading
from collections.abc import Sequence
from contextlib import suppress

from .descriptors import refuse

_HANGS_S = 3.0
"""One that says nothing for this long is ended and started anew."""
LEAVE = signal.SIGUSR1
"""Asks it to end by itself; what ends programs is ignored by it."""
_STARTS_S = 15.0
"""It may take this long to say its first word."""

vars(subprocess)["_USE_VFORK"] = (
    False  # as its documentation has it: a vfork waits until the disk has given the program
)


class StartError(Exception):
    """Nothing can be started now; there may be a descriptor, or a thread, later. The text says what is missing."""


class Child:
    """The process and the socket to it. It is started by a thread: a disk that hangs holds up nothing else.

    Args:
        name: For people.
        command: Its arguments; the number of the socket comes after them.
        config: File descriptor of its configuration, whose number comes after that.
        now: [s]
        inherited: Further file descriptors that it gets, whose numbers come after that.

    Raises:
        StartError: There is no descriptor left for the socket to it, or no thread.
    """

    def __init__(
        self, name: str, command: Sequence[str], config: int, now: float, inherited: tuple[int, ...] = ()
    ) -> None:
        self.name = name
        self.heard_at: float | None = None
        try:
            self.socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        except OSError as error:
            raise StartError(error.strerror) from error
        self.socket.setblocking(False)
        refuse(self.socket)
        self.gone = False
        """It has closed its end."""
        self._started_at = now
        self._process: subprocess.Popen[bytes] | None = None
        self._failed = ""
        self._ended = False
        files = (config, *inherited)
        try:
            threading.Thread(target=self._start, args=(tuple(command), theirs, files), daemon=True).start()
        except (RuntimeError, MemoryError) as error:
            self.socket.close()
            theirs.close()
            raise StartError(str(error) or "no memory") from error

    @property
    def pid(self) -> int:
        """0: it is being started."""
        return self._process.pid if self._process is not None else 0

    def ended(self, now: float) -> str:
        """Why it has to be started anew; empty: it has not."""
        if self._failed:
            return f"cannot be started: {self._failed}"
        status = self._process.poll() if self._process is not None else None
        if status is not None:
            return f"ended with status {status}"
        if self.gone:
            return "ended"
        if self.heard_at is None:
            return f"did not start within {_STARTS_S:g} s" if now - self._started_at > _STARTS_S else ""
        return f"hangs for {_HANGS_S:g} s" if now - self.heard_at > _HANGS_S else ""

    def leave(self) -> None:
        """Have it end by itself and leave its graph in order, when nothing is wanted of it any more; `end` it after."""
        if self._process is not None:
            self._process.send_signal(LEAVE)

    def end(self) -> None:
        """Have the kernel end it. One that cannot die now is not waited for."""
        self._ended = True
        self.socket.close()
        if self._process is not None:
            self._process.kill()

    def reaped(self) -> bool:
        """Whether nothing is left of it."""
        return bool(self._failed) or (self._process is not None and self._process.poll() is not None)

    def _start(self, command: tuple[str, ...], theirs: socket.socket, files: tuple[int, ...]) -> None:
        with theirs:
            with suppress(OSError):  # it takes its own priority, and is to start with none
                os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
            try:
                self._process = subprocess.Popen(
                    [*command, *map(str, (theirs.fileno(), *files))],
                    stdin=subprocess.DEVNULL,
                    pass_fds=[theirs.fileno(), *files],
                    start_new_session=True,  # a Ctrl-C is for the guard, which ends its children when the wheels stand
                )
            except (OSError, MemoryError) as error:
                self._failed = getattr(error, "strerror", None) or str(error) or type(error).__name__
        if self._ended and self._process is not None:
            self._process.kill()
