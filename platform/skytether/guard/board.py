"""What the wheels were really told last, where guard, gate and writer see it at once: a page of memory of all three.

Whoever tells the wheels something writes it down here in the same moment. So the one who takes over begins from there,
also when those who could have told it are dead or frozen, and sees whether anybody else still speaks. A message would
come too late for both: it takes a turn of each process on its way.
"""

from __future__ import annotations

import fcntl
import mmap
import os
import signal
import struct
import time
from enum import IntEnum
from hashlib import blake2b
from math import inf, isfinite, isnan, nan
from typing import NamedTuple
from zlib import crc32

from .kernel_buffers import is_anything_unacknowledged
from .protocol import LastCommand
from .velocity import Velocity

_MOST_HEARERS = 48
_ENTRY = struct.Struct(f"<Qddddd{_MOST_HEARERS}Q")
_SUM = struct.Struct("<I")
_SLOT = 512
"""Bytes between two entries: no two in one line of the processor's cache."""
_SIZE = 4096
_LOCK = struct.Struct("hhqqi0q")
"""``struct flock`` of the kernel."""
_LOOKS = 8
"""At somebody who may stand still."""
_PROCESSES = 1 << 32
"""More than there are."""
_SEALS = fcntl.F_SEAL_SEAL | fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW


class Role(IntEnum):
    """Who tells the wheels."""

    FIRST = 0
    """The guard, or on a graph the writer."""
    SECOND = 1
    """The gate, while the first says nothing."""


_KEEPERS = len(Role) * _PROCESSES
"""From where a role locks the one byte to where it locks the other."""


class Entry(NamedTuple):
    """What one of them has written down."""

    told: LastCommand = LastCommand()
    claim: float = nan
    """Since when it wants to tell the wheels what the other one has told them so far [s]; NaN: it does not."""
    left_at: float = -inf
    """When the last was told that is known to have left, or been heard, or the first after a standstill [s].

    The wheels have heard something after that, or nothing since.
    """
    hearers: frozenset[int] = frozenset()
    """Who listened as the last was told, by `mark`; of very many only some."""

    @property
    def sign(self) -> float:
        """When it last gave a sign of life [s]; NaN: never."""
        return self.claim if not self.told.at >= self.claim and isfinite(self.claim) else self.told.at


def mark(name: str) -> int:
    """What somebody who listens is known by on the board."""
    return int.from_bytes(blake2b(name.encode(), digest_size=8).digest()) or 1


class Place(NamedTuple):
    """Where each process of a role locks one byte, that of its own number, while it tells the wheels something."""

    file: int
    """Descriptor of the board."""
    start: int

    def keep(self) -> None:
        """Say, until this process ends, that its connections keep what was not acknowledged, and send it again.

        Raises:
            OSError: The kernel does not take it.
        """
        fcntl.lockf(self.file, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, self.start + _KEEPERS + os.getpid())

    def keeper(self) -> int:
        """A process that said so, and has something that was not acknowledged; 0: there is none."""
        pid = self._holder(self.start + _KEEPERS)
        return pid if pid and is_anything_unacknowledged(pid) else 0

    def end_speaker(self, patience_s: float) -> int:
        """End a process that stands still as it tells the wheels something.

        It looked at the clock before. If it was frozen since then, it would go on with that, whatever the wheels were
        told meanwhile; one that the kernel ends goes on with nothing.

        Args:
            patience_s: Who is done in that time does not stand still: it takes 0.1 ms, and some while others come to
                DDS or go [s].

        Returns:
            Its number; 0: there is none, or it is not ours to end.
        """
        pid = self._holder(self.start)
        for _ in range(_LOOKS):
            if not pid:
                return 0
            time.sleep(patience_s / _LOOKS)
            pid = pid if self._holder(self.start) == pid else 0
        return end(pid)

    def _holder(self, start: int) -> int:
        asked = _LOCK.pack(fcntl.F_WRLCK, os.SEEK_SET, start, _PROCESSES, 0)
        try:
            kind, _, _, _, pid = _LOCK.unpack(fcntl.fcntl(self.file, fcntl.F_GETLK, asked))
        except OSError:
            return 0
        return 0 if kind == fcntl.F_UNLCK else max(0, int(pid))


def end(pid: int) -> int:
    """End a process: its number; 0: it is gone, or not ours to end."""
    try:
        os.kill(pid, signal.SIGKILL)
    except OSError:
        return 0
    return pid


class Board:
    """The page. Each role has two places and writes to them in turn: one that dies while it writes spoils only one.

    Args:
        file: Made by `make`; its number is the same in the children.
    """

    def __init__(self, file: int) -> None:
        self._page = mmap.mmap(file, _SIZE)
        self._file = file

    def put(self, role: Role, entry: Entry) -> None:
        """Write down. Only one process at a time may have a role."""
        (first, _), (second, _) = self._at(role, 0), self._at(role, 1)
        place, count = (1, first) if first > second else (0, second)
        hearers = sorted(entry.hearers)[:_MOST_HEARERS]
        hearers += [0] * (_MOST_HEARERS - len(hearers))
        data = _ENTRY.pack(count + 1, *entry.told.velocity, entry.told.at, entry.claim, entry.left_at, *hearers)
        start = _SLOT * (2 * role + place)
        self._page[start : start + _ENTRY.size + _SUM.size] = data + _SUM.pack(crc32(data))

    def of(self, role: Role) -> Entry:
        """What somebody wrote down last."""
        return max(self._at(role, 0), self._at(role, 1), key=lambda found: found[0])[1]

    def newest(self) -> Entry:
        """Of who told the wheels something last."""
        first, second = self.of(Role.FIRST), self.of(Role.SECOND)
        return first if isnan(second.told.at) or second.told.at < first.told.at else second

    def place(self, role: Role) -> Place:
        """Where those of a role lock."""
        return Place(self._file, (1 + role) * _PROCESSES)

    def close(self) -> None:
        """Let go of the page."""
        self._page.close()

    def _at(self, role: Role, place: int) -> tuple[int, Entry]:
        """How many there were before it, and what it says; 0: nothing."""
        start = _SLOT * (2 * role + place)
        data = self._page[start : start + _ENTRY.size + _SUM.size]
        if _SUM.unpack_from(data, _ENTRY.size)[0] != crc32(data[: _ENTRY.size]):
            return 0, Entry()
        count, linear, angular, at, claim, left_at, *hearers = _ENTRY.unpack_from(data)
        told = LastCommand(Velocity(linear, angular), at)
        return count, Entry(told, claim, left_at, frozenset(hearers) - {0})


def make() -> int:
    """A page for `Board`, in which nothing is written yet.

    Raises:
        OSError: The kernel does not make it.
    """
    file = os.memfd_create("skytether-told", os.MFD_ALLOW_SEALING)
    os.ftruncate(file, _SIZE)
    fcntl.fcntl(file, fcntl.F_ADD_SEALS, _SEALS)  # nobody can take the page away from the others
    return file
