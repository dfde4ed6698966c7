"""Counters, quantiles and sequence gaps: what quality of service is computed from (rule 11)."""

from __future__ import annotations

import math
from array import array
from collections import deque

import numpy as np
import numpy.typing as npt

_GROWTH = math.log(1.02)
_SMALLEST = 1e-6
_LARGEST = 86_400.0
_COLLECT = 512
"""Arrivals held before they are counted: 16 KiB of each topic."""


Values = npt.NDArray[np.float64]
_NONE: Values = np.empty(0)


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


class _Gap:
    __slots__ = ("deadline", "end", "filled", "first")

    def __init__(self, first: int, end: int, deadline: float) -> None:
        self.first = first
        self.end = end
        self.deadline = deadline
        self.filled = 0


class SequenceTracker:
    """Which sequence numbers of a topic are missing, and since when.

    A gap counts as lost once it is older than the topic's lifespan. Every number is observed at most once (the
    replay window sees to that), so a number below the next expected one fills a gap.
    """

    MAX_GAPS = 1024
    """Gaps that may be open; the oldest is settled early beyond that."""

    __slots__ = ("_gaps", "_lifespan", "lost", "next", "received")

    def __init__(self, lifespan: float) -> None:
        self._lifespan = lifespan
        self._gaps: deque[_Gap] = deque()
        self.next = 0
        """Lowest number above all that the sender is known to have used."""
        self.received = 0
        self.lost = 0
        """Numbers that went missing, without those that came late after all."""

    def observe(self, sequence: int, now: float) -> bool:
        """Take an arrival.

        Returns:
            True if the number had been counted lost.
        """
        self.received += 1
        if sequence == self.next:
            self.next += 1
            return False
        if sequence > self.next:
            self._open(sequence, now)
            self.next = sequence + 1
            return False
        for gap in self._gaps:
            if gap.first <= sequence < gap.end:
                gap.filled += 1
                return False
        self.lost -= 1
        return True

    def sent(self, count: int, now: float) -> None:
        """The sender says that it has used all numbers below ``count``."""
        if count > self.next:
            self._open(count, now)
            self.next = count

    def settle(self, now: float) -> None:
        """Count what is missing for too long."""
        gaps = self._gaps
        while gaps and gaps[0].deadline <= now:
            self._lose(gaps.popleft())

    def _open(self, end: int, now: float) -> None:
        self._gaps.append(_Gap(self.next, end, now + self._lifespan))
        if len(self._gaps) > self.MAX_GAPS:
            self._lose(self._gaps.popleft())

    def _lose(self, gap: _Gap) -> None:
        self.lost += gap.end - gap.first - gap.filled


class Outbound:
    """Counters of a topic at its sender, since the session object was made; names as in `stats.TopicStats`."""

    __slots__ = (
        "bytes_redundant", "bytes_sent", "expired", "offered", "payload_sent", "reliable", "replaced", "retransmitted",
        "sent",
    )  # fmt: skip

    def __init__(self) -> None:
        self.reliable = False
        """Whether the topic is."""
        self.bytes_redundant = 0
        """Of ``bytes_sent``, copies and parity."""
        self.offered = self.sent = self.expired = self.replaced = self.retransmitted = self.bytes_sent = 0
        self.payload_sent = 0


class Inbound:
    """Counters of a topic at its receiver, since the session object was made; names as in `stats.TopicStats`.

    The times of arrivals are collected and counted together: call `settle` before reading what depends on them.
    """

    __slots__ = (
        "_arrival", "_arrivals", "_delay", "_delay_in_order", "bytes_delivered", "delay", "delay_error", "delivered",
        "duplicate", "expired", "jitter", "jitter_in_order", "late", "lost", "period", "superseded",
    )  # fmt: skip

    def __init__(self) -> None:
        self.delivered = self.lost = self.late = self.expired = self.superseded = self.duplicate = 0
        self.bytes_delivered = 0
        self.delay = Histogram()
        self.delay_error = math.nan
        """Largest error of the clock offset behind any of the delays."""
        self.period = Histogram()
        self.jitter = Mean()
        self.jitter_in_order = Mean()
        self._arrivals = array("d")
        """Of each: time, delay, error of the delay, whether in order."""
        self._arrival = self._delay = self._delay_in_order = _NONE
        """The last of each that was counted."""

    def arrived(self, delay: float, error: float, in_order: bool, now: float) -> None:
        """Take the times of one authentic message; ``error`` is inf while the clock offset is unknown."""
        self._arrivals.extend((now, delay, error, in_order))
        if len(self._arrivals) >= 4 * _COLLECT:
            self.settle()

    def settle(self) -> None:
        """Count what arrived since the last call."""
        if not self._arrivals:
            return
        times, delays, errors, in_order = np.array(self._arrivals).reshape(-1, 4).T
        self._arrivals = array("d")
        times = np.append(self._arrival, times)
        self.period.add_all(np.diff(times))
        self._arrival = times[-1:]
        known = errors < math.inf
        if not known.any():
            return
        worst = float(errors[known].max())
        if not worst <= self.delay_error:
            self.delay_error = worst
        self.delay.add_all(delays[known])
        self._delay = self.jitter.add_steps(self._delay, delays[known])
        self._delay_in_order = self.jitter_in_order.add_steps(self._delay_in_order, delays[known & (in_order > 0)])


class Mean:
    """Running mean."""

    __slots__ = ("_count", "_sum")

    def __init__(self) -> None:
        self._sum = 0.0
        self._count = 0

    def add_steps(self, last: Values, values: Values) -> Values:
        """Take how far each value is from the one before, the first from ``last``; returns the last."""
        values = np.append(last, values)
        steps = np.abs(np.diff(values))
        self._sum += float(steps.sum())
        self._count += len(steps)
        return values[-1:]

    @property
    def value(self) -> float:
        """NaN if there are no values."""
        return self._sum / self._count if self._count else math.nan
