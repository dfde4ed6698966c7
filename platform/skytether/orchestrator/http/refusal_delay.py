"""Who is refused for nothing but their own fault waits for it: it costs them time, and nobody work."""

from __future__ import annotations

import asyncio

_FIRST_S = 0.25
"""Before an answer, where nobody else waits for one."""
_LONGEST_S = 5.0
_AT_ONCE = 64
"""For each so many who wait already, the wait is longer by the first: however many connections somebody opens, some
256 are refused in a second, until all wait the longest."""


class RefusalDelay:
    """Of who waits for a refusal; each has a connection, which is what bounds their number."""

    def __init__(self, first_s: float = _FIRST_S) -> None:
        self._first_s = first_s
        self._waiting = 0

    @property
    def next_s(self) -> float:
        """Of the next who comes."""
        return min(_LONGEST_S, self._first_s * (1 + self._waiting / _AT_ONCE))

    async def wait(self) -> None:
        """Before a refusal."""
        seconds = self.next_s
        self._waiting += 1
        try:
            await asyncio.sleep(seconds)
        finally:
            self._waiting -= 1
