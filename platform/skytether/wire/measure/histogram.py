"""Quantiles of seconds in bounded memory."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

_GROWTH = math.log(1.02)
_SMALLEST = 1e-6
_LARGEST = 86_400.0

Values = npt.NDArray[np.float64]


class Histogram:
    """Quantiles of positive seconds within 1 %, in bounded memory: logarithmic buckets, each 2 % wide.

    One microsecond to a day makes 1,272 buckets.
    """

    __slots__ = ("_counts", "maximum", "minimum", "total")

    def __init__(self) -> None:
        self._counts = np.zeros(_bucket(_LARGEST) + 1, np.int64)
        self.total = 0
        self.maximum = self.minimum = math.nan

    def add(self, seconds: float) -> None:
        """Take one value; below a microsecond (or negative, by a clock's error) counts as one."""
        seconds = min(max(seconds, _SMALLEST), _LARGEST)
        self._counts[_bucket(seconds)] += 1
        self._extend(seconds, seconds, 1)

    def add_all(self, seconds: Values) -> None:
        """Take several."""
        if len(seconds):
            seconds = np.clip(seconds, _SMALLEST, _LARGEST)
            buckets = (np.log(seconds / _SMALLEST) / _GROWTH).astype(np.intp)
            self._counts += np.bincount(buckets, minlength=len(self._counts))
            self._extend(float(seconds.min()), float(seconds.max()), len(seconds))

    def quantile(self, share: float) -> float:
        """Value that ``share`` of all are at most; NaN if there are none."""
        if not self.total:
            return math.nan
        bucket = int(np.searchsorted(np.cumsum(self._counts), max(share * self.total, 1)))
        return _SMALLEST * math.exp((bucket + 0.5) * _GROWTH)

    def _extend(self, least: float, most: float, count: int) -> None:
        if not most <= self.maximum:
            self.maximum = most
        if not least >= self.minimum:
            self.minimum = least
        self.total += count


def _bucket(seconds: float) -> int:
    return int(math.log(seconds / _SMALLEST) / _GROWTH)
