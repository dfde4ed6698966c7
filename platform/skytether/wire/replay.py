"""Which message numbers were accepted already: a sliding window, after RFC 6479."""

from __future__ import annotations

from enum import Enum


class Seen(Enum):
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

    def check(self, number: int) -> Seen:
        """Without changing anything."""
        if number > self.highest:
            return Seen.NEW
        if number <= self.highest - self.SIZE:
            return Seen.OLD
        return Seen.ACCEPTED if self._ring[number % self.SIZE] else Seen.NEW

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
