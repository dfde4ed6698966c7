"""Which numbers of messages and packets were accepted already: a sliding window, after RFC 6479."""

from __future__ import annotations

from enum import Enum

import numpy as np
import numpy.typing as npt


class ReplayVerdict(Enum):
    """What the window knows of a number."""

    NEW = 0
    ACCEPTED = 1
    OLD = 2
    """Left the window: cannot be told from a repetition, so it is refused."""


class ReplayWindow:
    """One byte per number in a ring: accepting one is two list operations, and a jump clears what it skipped.

    Only authenticated messages may move it: call `accept` after opening, `check` before.
    """

    SIZE = 65_536
    """More messages than any path reorders; 64 KiB."""

    __slots__ = ("_ring", "highest")

    def __init__(self) -> None:
        self._ring = bytearray(self.SIZE)
        self.highest = -1
        """Highest number accepted."""

    def check(self, number: int) -> ReplayVerdict:
        """Without changing anything."""
        if number > self.highest:
            return ReplayVerdict.NEW
        if number <= self.highest - self.SIZE:
            return ReplayVerdict.OLD
        return ReplayVerdict.ACCEPTED if self._ring[number % self.SIZE] else ReplayVerdict.NEW

    def accept(self, number: int) -> bool:
        """Remember an authenticated number.

        Returns:
            False if it was accepted before or is too old to tell.
        """
        size, ring, highest = self.SIZE, self._ring, self.highest
        if number > highest:
            skipped = number - highest - 1
            if skipped >= size:
                ring[:] = bytes(size)
            elif skipped:
                start, end = (highest + 1) % size, number % size
                if start < end:
                    ring[start:end] = bytes(end - start)
                else:
                    ring[start:] = bytes(size - start)
                    ring[:end] = bytes(end)
            self.highest = number
        elif number <= highest - size or ring[number % size]:
            return False
        ring[number % size] = 1
        return True


class PacketWindow(ReplayWindow):
    """The same for packet numbers of a path, which have 32 bits and begin anywhere."""

    SIZE = 16_384
    """More packets than any path reorders; 16 KiB for each path."""
    NUMBERS = 2**32

    __slots__ = ()

    def accept(self, number: int) -> bool:
        if number == (self.highest + 1) % self.NUMBERS:  # as nearly always
            self.highest += 1
            self._ring[self.highest % self.SIZE] = 1
            return True
        return super().accept(self._whole(number))

    def accept_all(self, numbers: npt.NDArray[np.uint32]) -> npt.NDArray[np.bool_] | None:
        """The same for several, in the order in which they came; which of them were new, None for all."""
        first, count, size = self._whole(int(numbers[0])), len(numbers), self.SIZE
        start = first % size
        if first > self.highest and start + count <= size:
            expected = np.arange(first, first + count).astype(np.uint32)
            if numbers.tobytes() == expected.tobytes():  # as nearly always
                super().accept(first)
                self._ring[start : start + count] = b"\1" * count
                self.highest = first + count - 1
                return None
        new = np.array([self.accept(number) for number in numbers.tolist()])
        return None if new.all() else new

    def _whole(self, number: int) -> int:
        """With the bits that packets do not carry."""
        if self.highest < 0:
            return number
        half = self.NUMBERS // 2
        return self.highest + (number - self.highest + half) % self.NUMBERS - half
