"""What has stood in its place for a while: no new person begins there."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_CELL = 0.12
"""Side of a square of the floor, m: a leg."""
_STOOD = 1.0
"""Something seen in a square for longer than this stands there, s: a foot rests for half as long in a slow walk."""
_FORGOTTEN = 1.0
"""A square in which nothing was seen for this long is as new, s."""
_MOST = 20_000
"""Squares that are kept: a scan has 2,000 rays at the most that matter, and a robot sees new ones for a second."""


class Background:
    """Squares of the floor, and since when something is seen in each."""

    def __init__(self) -> None:
        self._seen: dict[tuple[int, int], tuple[float, float]] = {}
        self._tidied_at = 0.0

    def stands(self, place: NDArray[np.float64], now: float, stood: float = _STOOD) -> bool:
        """Whether something was in the square of this place [m, frame that does not move] for so long [s]."""
        since = self._seen.get(_square(place))
        return since is not None and now - since[0] > stood and now - since[1] <= _FORGOTTEN

    def add(self, points: NDArray[np.float64], now: float) -> None:
        """Take all points of a scan, n by (x, y) [m, frame that does not move]."""
        if now - self._tidied_at > _FORGOTTEN or now < self._tidied_at or len(self._seen) > _MOST:
            self._tidied_at = now
            self._seen = {square: times for square, times in self._seen.items() if 0 <= now - times[1] <= _FORGOTTEN}
        seen = self._seen
        for square in set(map(tuple, np.floor(points / _CELL).astype(np.int64).tolist())):
            times = seen.get(square)
            if times is not None and now - times[1] <= _FORGOTTEN:
                seen[square] = (times[0], now)
            elif times is not None or len(seen) < _MOST:
                seen[square] = (now, now)


def _square(place: NDArray[np.float64]) -> tuple[int, int]:
    x, y = np.floor(place / _CELL).astype(np.int64).tolist()
    return x, y
