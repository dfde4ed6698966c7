"""The emergency stop as the guard keeps it: in effect at once, acknowledged when it is on disk.

The file says ``stopped`` or ``released`` on its first line, then the boot that this was said in, then the reason. Only
a whole file of this boot that says ``released`` releases: whatever else is found, the robot starts stopped. A machine
that was started is therefore stopped until a person resets it.

Where the folder of the sockets is emptied by a reboot, a second such file lies on a disk, beside the event record: a
stop that a person asked for is then still told from the first act of a machine that was started.
"""

from __future__ import annotations

import errno
import os
import stat
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple

from .folder import trusted
from .protocol import FIRST_ACT, REASON_BYTES, cut

SIZE = 512
"""Bytes of the file: one block, written in place, which needs no room on a full disk."""
_STOPPED, _RELEASED, _END = "stopped", "released", b"\nend\n"
_BOOT_BYTES = 64
_AGAIN = " (before the guard was started again)"
LATCH_FILE = "latch"
"""In the folder of the sockets."""


def boot_id() -> str:
    """Differs from boot to boot; empty: not known."""
    try:
        with open("/proc/sys/kernel/random/boot_id", encoding="ascii") as file:
            return file.read(_BOOT_BYTES).strip()
    except (OSError, ValueError):
        return ""


def clean(reason: object) -> str:
    """A reason on one line of printable characters, at most `REASON_BYTES` long."""
    text = "" if reason is None else str(reason)[: 2 * REASON_BYTES]
    line = "".join(c if c.isprintable() else " " for c in cut(text, 4 * REASON_BYTES).decode())
    return cut(" ".join(line.split()), REASON_BYTES).decode().strip()


def encode(reason: str, boot: str) -> bytes:
    """The file; an empty reason: released."""
    state = _STOPPED if reason else _RELEASED
    text = f"{state}\n{boot}\n{clean(reason)}".encode()
    return text.ljust(SIZE - len(_END)) + _END


def decode(data: bytes | None, boot: str) -> str:
    """Why the robot is to stand from the start; empty: it was released in this boot.

    Args:
        data: Of the file; None: there is none.
        boot: Of now; empty: not known.
    """
    if data is None:
        return FIRST_ACT
    try:
        state, then, reason = data[: -len(_END)].decode().split("\n", 2)
    except ValueError:
        return "what was kept of the emergency stop cannot be read"
    if len(data) != SIZE or not data.endswith(_END) or state not in (_STOPPED, _RELEASED):
        return "what was kept of the emergency stop is damaged"
    if state == _STOPPED and reason.startswith(FIRST_ACT):
        return FIRST_ACT
    if state == _STOPPED:
        return clean(clean(reason).removesuffix(_AGAIN)[: REASON_BYTES - len(_AGAIN)] + _AGAIN)
    return "" if boot and then == boot else FIRST_ACT


def _open(path: str, flags: int) -> int:
    """A file that nobody else can have put there: in a folder with the sticky bit a group may make files.

    Raises:
        OSError: It cannot be opened, is no file, or is another user's.
    """
    file = os.open(path, flags | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOFOLLOW, 0o600)  # a pipe must not hold it up
    try:
        about = os.fstat(file)
        if not stat.S_ISREG(about.st_mode) or about.st_uid not in trusted(os.path.dirname(path) or "."):
            raise OSError(errno.EPERM, "it is no file of this user")
    except OSError:
        os.close(file)
        raise
    return file


def lasting_file(folder: str, record: str) -> str:
    """The second file, beside the event record; empty: that is in the folder itself, and the first one is enough."""
    return "" if os.path.dirname(record) == folder.rstrip("/") else f"{record}-latch"


class Kept(NamedTuple):
    """How far the keeping is."""

    done: int
    """The newest change that was dealt with."""
    error: str
    """Why it could not be kept; empty: it is on disk."""


class EstopFile:
    """Writes the file in a thread of its own, so that no loop ever waits for a disk.

    Args:
        path: Of the file.
        boot: Of now.
        trouble: Told, in that thread, what could not be written.
        lasting: The second file, see `lasting_file`; empty: there is none.
    """

    def __init__(self, path: str, boot: str, trouble: Callable[[str], object], lasting: str = "") -> None:
        self.kept = Kept(0, "")
        self._path = path
        self._lasting = lasting
        self._boot = boot
        self._trouble = trouble
        self._wanted = (0, "")
        self._changed = threading.Event()

    def before(self) -> str:
        """Why the robot is to stand from the start; empty: it is not."""
        found = self._read(self._path)
        if found not in ("", FIRST_ACT) or not self._lasting:
            return found
        before = self._read(self._lasting)  # that there is none, or one of another boot, tells nothing more
        return found if before in ("", FIRST_ACT) else before

    def _read(self, path: str) -> str:
        try:
            file = _open(path, os.O_RDONLY)
            try:
                return decode(os.read(file, 2 * SIZE), self._boot)
            finally:
                os.close(file)
        except FileNotFoundError:
            return decode(None, self._boot)
        except OSError as error:
            return f"whether it was stopped before cannot be read: {error.strerror}"

    def start(self) -> None:
        """Begin to keep."""
        threading.Thread(target=self._run, name="keeper", daemon=True).start()

    def keep(self, number: int, reason: str) -> None:
        """Have a change written; returns at once. ``kept.done`` reaches the number when it was dealt with."""
        self._wanted = (number, reason)
        self._changed.set()

    def _run(self) -> None:
        while True:
            self._changed.wait()
            self._changed.clear()
            number, reason = self._wanted
            error = self._keep(reason)
            self.kept = Kept(number, error)
            if error:
                with suppress(Exception):  # whoever is told has a bug: the next change is to be kept all the same
                    self._trouble(error)

    def _keep(self, reason: str) -> str:
        """Why not; empty: it is."""
        wrong = []
        for path in filter(None, (self._path, self._lasting)):
            error = self._write(path, reason)
            if error:
                wrong.append(f"cannot write {path}: {error}")
        return "; ".join(wrong)

    def _write(self, path: str, reason: str) -> str:
        try:
            if path == self._lasting:
                os.makedirs(os.path.dirname(path), mode=0o750, exist_ok=True)
            file = _open(path, os.O_WRONLY | os.O_CREAT)
            try:
                written = os.pwrite(file, encode(reason, self._boot), 0)
                os.fsync(file)
            finally:
                os.close(file)
        except Exception as error:  # whatever it is, the next change is to be kept
            if reason:  # a file that says released is worse than none, and to remove it needs no room
                with suppress(OSError):
                    os.unlink(path)
                    return "" if path == self._path else str(error)  # after a reboot that would be nobody's stop
            return str(error)
        return "" if written == SIZE else "the disk is full"


class KeptEstop:
    """The emergency stop.

    Args:
        keeper: Of its file.
    """

    def __init__(self, keeper: EstopFile) -> None:
        self._keeper = keeper
        self.reason = keeper.before()
        """Why the robot stands until a person resets it; empty: it does not."""
        self.generation = 1
        self._changes = 1
        keeper.keep(self._changes, self.reason)

    def stop(self, reason: str) -> bool:
        """In effect at once. The first reason is kept, but for `FIRST_ACT`, which is nobody's. True if this is new."""
        reason = clean(reason) or "somebody asked for it"
        if self.reason not in ("", FIRST_ACT) or reason == self.reason:
            return False
        self._change(reason)
        return True

    def renew(self) -> None:
        """A person stops a robot that is stopped already: a reset that was asked for before does not end this.

        What could not be kept before is tried again: the disk may have room by now.
        """
        self.generation += 1
        if self.unkept:
            self._changes += 1
            self._keeper.keep(self._changes, self.reason)

    def reset(self, generation: int) -> bool:
        """End the stop that whoever asks knows of; a newer one stays. True if it was stopped and is no more."""
        if not self.reason or generation != self.generation:
            return False
        self._change("")
        return True

    @property
    def kept(self) -> bool:
        """It is on disk as it is."""
        return self._keeper.kept == (self._changes, "")

    @property
    def unkept(self) -> str:
        """Why it could not be kept; empty: it is, or is being written."""
        done, error = self._keeper.kept
        return error if done == self._changes else ""

    def _change(self, reason: str) -> None:
        self.reason = reason
        self.generation += 1
        self._changes += 1
        self._keeper.keep(self._changes, reason)
