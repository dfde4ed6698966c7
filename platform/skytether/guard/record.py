"""The safety event record: what stopped the robot, who reset it, what died; bounded, and it survives a reboot.

A ring of slots in one file that has its full size from the start, so that a full disk does not stop it. Each slot is a
line of JSON. Nothing waits for it: a thread writes, and what it cannot write in time is counted.
"""

from __future__ import annotations

import errno
import fcntl
import json
import os
import threading
from collections import deque
from contextlib import suppress

SLOTS = 4096
SLOT_BYTES = 512
"""2 MiB in all: years of a robot that is stopped now and then, hours of one that is ill."""
_WAITING = 256
_IN_MEMORY = ("tmpfs", "ramfs", "devtmpfs")
_DETAIL = 300
"""Characters of a detail; as JSON each may take six bytes, so it is cut again until it fits."""


def encode(event: dict[str, object]) -> bytes:
    """One slot."""
    detail = str(event.get("detail", ""))[:_DETAIL]
    while True:
        data = json.dumps(event | {"detail": detail}, ensure_ascii=False).encode(errors="replace")
        if len(data) < SLOT_BYTES:
            return data.ljust(SLOT_BYTES - 1) + b"\n"
        detail = detail[: len(detail) * 3 // 4]


def decode(data: bytes) -> list[dict[str, object]]:
    """All events of a file, oldest first; slots that are damaged are left out."""
    found = []
    for start in range(0, len(data), SLOT_BYTES):
        with suppress(ValueError):
            event = json.loads(data[start : start + SLOT_BYTES])
            if isinstance(event, dict) and isinstance(event.get("n"), int):
                found.append(event)
    return sorted(found, key=lambda event: int(str(event["n"])))


def lost_at_reboot(path: str, mounts: str = "/proc/self/mountinfo") -> str:
    """Says that a reboot empties the file system that a file is on, or will be on; empty: it does not, as far as known.

    By what the kernel says of the file system, whatever the path looks like.

    Args:
        path: Of the file.
        mounts: The kernel's list.
    """
    place = os.path.abspath(path)
    while not os.path.exists(place):
        place = os.path.dirname(place)
    try:
        device = os.stat(place).st_dev
        with open(mounts, encoding="utf-8", errors="replace") as lines:
            found = [line.split() for line in lines]
    except OSError:
        return ""
    for fields in found:
        if fields[2:3] == [f"{os.major(device)}:{os.minor(device)}"] and "-" in fields[:-1]:
            kind = fields[fields.index("-") + 1]
            if kind in _IN_MEMORY:
                return (
                    f"the event record {path} is on a {kind}: a reboot empties it, and a stop that is kept "
                    "beside it; name a file on a disk: safety.record"
                )
    return ""


class Record:
    """Writes events.

    Args:
        path: Of the file; its folder is made.
        boot: Of now.
    """

    def __init__(self, path: str, boot: str) -> None:
        self.trouble = ""
        """Why nothing is recorded at the moment; empty: it is."""
        self.note = ""
        """What people should know of where it is."""
        self._path = path
        self._boot = boot
        self._waiting: deque[dict[str, object]] = deque()
        self._there = threading.Semaphore(0)
        self._lost = 0
        self._next = 0
        self._written = 0
        self._said = 0
        threading.Thread(target=self._run, name="record", daemon=True).start()

    def add(self, who: str, what: str, detail: str, wall: float, at: float) -> None:
        """Have an event written.

        Args:
            who: ``guard``, ``gate``, ``writer``.
            what: A word for programs.
            detail: A sentence for people.
            wall: Seconds since 1970, as far as the machine knows.
            at: `clock.now` [s].
        """
        if len(self._waiting) >= _WAITING:
            self._lost += 1
            return
        event = {"wall": round(wall, 3), "at": round(at, 3), "boot": self._boot, "who": who, "what": what}
        self._said += 1
        self._waiting.append(event | {"detail": detail})
        self._there.release()

    @property
    def written(self) -> bool:
        """Nothing waits."""
        return self._written >= self._said

    def _run(self) -> None:
        file = -1
        while True:
            self._there.acquire()
            event = self._waiting.popleft()
            if self._lost:
                event["lost_before"], self._lost = self._lost, 0
            try:
                if file < 0:
                    file = self._open()
                    self.note = lost_at_reboot(self._path)
                os.pwrite(file, encode({"n": self._next} | event), self._next % SLOTS * SLOT_BYTES)
                self._next += 1
                if not self._waiting:
                    os.fdatasync(file)
                self.trouble = ""
            except OSError as error:
                self.trouble = f"the event record {self._path} cannot be written: {error.strerror}"
                self._lost += 1
            self._written += 1

    def _open(self) -> int:
        folder = os.path.dirname(self._path)
        os.makedirs(folder, mode=0o750, exist_ok=True)
        file = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o640)
        try:
            self._claim(file)
            os.posix_fallocate(file, 0, SLOTS * SLOT_BYTES)
            events = decode(os.pread(file, SLOTS * SLOT_BYTES, 0))
        except OSError:
            os.close(file)
            raise
        self._next = int(str(events[-1]["n"])) + 1 if events else 0
        return file

    def _claim(self, file: int) -> None:
        """Two that write into one file overwrite each other's slots."""
        try:
            fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno not in (errno.EACCES, errno.EAGAIN):
                return  # a file system without locks
            sentence = "another robot's guard writes it; name one of this robot's own: safety.record"
            raise OSError(errno.EBUSY, sentence) from error
