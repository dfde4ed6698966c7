"""How long a sender may be silent, from how regularly it was heard: an accrual failure detector.

As in the phi accrual detector (Hayashibara et al., SRDS 2004), what is suspected follows from the distribution of the
gaps between arrivals that were seen. The distribution here has two parts. Its tail is exponential above the ninth
decile: a normal distribution, as in the paper, takes the pauses of a busy computer for impossible. And the longest gap
of the last hour is expected again: pauses come in families, when another program runs, or the radio looks for a base.
Pure: time is an argument.
"""

from __future__ import annotations

from collections import deque
from math import ceil, exp, log

LEAST_PERIODS = 2.5
"""No silence shorter than that is suspected: one message may be lost, and the next be half a period late."""
_ORDINARY_S = 0.03
"""Nor one that is less than that longer than two periods: pauses of a computer without real-time scheduling."""
_LOST = 3
"""Messages that were lost, to tell a cut from a pause: who pauses sends nothing, and loses nothing."""
_CHANCE = 1e-6
"""Of a gap that is longer than the limit, by the tail: once in three hours at 100 Hz."""
_WINDOW = 400
"""Newest gaps that the tail is fitted to: half a minute at 13 Hz."""
_TAIL = 0.1
"""Share of them that is the tail."""
_LEARNED_AFTER = 40
_LEARNED_AFTER_S = 5.0
"""Gaps that must have been seen, over that time [s], before what was learned counts."""
_FIT_EVERY = 10
"""Gaps between two fits."""
_AGAIN = 1.25
"""A gap may come again this much longer."""
_HALVED_S = 3600.0
"""A longest gap counts half after this time [s]."""
_BUCKET_S = 60.0
_BUCKETS = 60


class AccrualDetector:
    """Learns the arrivals of one sender.

    Args:
        period_s: Between messages, as the sender says [s]; None: it does not say.
        most_s: The longest silence that may be waited for, whatever was learned [s].
        first_s: What is waited for before anything was learned, if a sender of that period does not need more [s].
    """

    def __init__(self, period_s: float | None, most_s: float, first_s: float) -> None:
        self._period_s = period_s
        self._most_s = most_s
        self._last: float | None = None
        self._gaps: deque[float] = deque(maxlen=_WINDOW)
        self._seen = 0
        self._begin: float | None = None
        self._longest: deque[tuple[float, float]] = deque(maxlen=_BUCKETS)
        """Longest gap of each minute that had any, with the minute's beginning; oldest first."""
        self._limit_s = min(max(first_s, LEAST_PERIODS * (period_s or 0.0)), most_s)

    def arrived(self, at: float, lost: int = 0) -> None:
        """A message came.

        Args:
            at: When [monotonic s].
            lost: Messages between it and the one before that did not come.
        """
        gap = at - self._last if self._last is not None else 0.0
        self._last = at
        if lost >= _LOST or not 0 < gap <= self._most_s:  # an outage, which says nothing about ordinary days
            return
        self._seen += 1
        self._begin = at if self._begin is None else self._begin
        self._gaps.append(gap)
        if not self._longest or not 0 <= at - self._longest[-1][0] < _BUCKET_S:
            self._longest.append((at, gap))
        elif gap > self._longest[-1][1]:
            self._longest[-1] = (self._longest[-1][0], gap)
        if self._seen < _LEARNED_AFTER or at - self._begin < _LEARNED_AFTER_S:
            return
        if self._seen % _FIT_EVERY == 0 or _AGAIN * gap > self._limit_s:
            self._limit_s = self._fit(at)

    @property
    def limit_s(self) -> float:
        """A longer silence is a sender that is gone [s]."""
        return self._limit_s

    def _fit(self, now: float) -> float:
        gaps = sorted(self._gaps)
        median = gaps[len(gaps) // 2]
        period = median if self._period_s is None else min(median, self._period_s)
        first = len(gaps) - ceil(_TAIL * len(gaps))
        begin = gaps[first - 1]
        excess = sum(gap - begin for gap in gaps[first:]) / (len(gaps) - first)
        tail = begin + excess * log(_TAIL / _CHANCE)
        again = max(_AGAIN * gap * exp(-(now - at) * log(2) / _HALVED_S) for at, gap in self._longest)
        return min(max(least_s(period), tail, again), self._most_s)


def least_s(period_s: float) -> float:
    """The silence that is suspected first, of a sender that is as regular as a clock [s]."""
    return max(LEAST_PERIODS * period_s, 2 * period_s + _ORDINARY_S)
