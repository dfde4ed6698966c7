"""Counters, quantiles and sequence gaps: what quality of service is computed from (rule 11)."""

from __future__ import annotations

import math
from collections import deque

_GROWTH = math.log(1.02)
_SMALLEST = 1e-6


class Histogram:
    """Quantiles of positive seconds within 1 %, in bounded memory: logarithmic buckets, each 2 % wide.

    One microsecond to a day makes 1,271 buckets at most.
    """

    __slots__ = ("_counts", "maximum", "minimum", "total")

    def __init__(self) -> None:
        self._counts: dict[int, int] = {}
        self.total = 0
        self.maximum = self.minimum = math.nan

    def add(self, seconds: float) -> None:
        """Take one value; below a microsecond (or negative, by a clock's error) counts as one."""
        seconds = min(max(seconds, _SMALLEST), 86_400.0)
        bucket = int(math.log(seconds / _SMALLEST) / _GROWTH)
        self._counts[bucket] = self._counts.get(bucket, 0) + 1
        if not seconds <= self.maximum:
            self.maximum = seconds
        if not seconds >= self.minimum:
            self.minimum = seconds
        self.total += 1

    def quantile(self, share: float) -> float:
        """Value that ``share`` of all are at most; NaN if there are none."""
        wanted = share * self.total
        seen = 0
        for bucket in sorted(self._counts):
            seen += self._counts[bucket]
            if seen >= wanted:
                return _SMALLEST * math.exp((bucket + 0.5) * _GROWTH)
        return math.nan


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
        "bytes_redundant", "bytes_sent", "expired", "offered", "payload_sent", "replaced", "retransmitted", "sent",
    )  # fmt: skip

    def __init__(self) -> None:
        self.bytes_redundant = 0
        """Of ``bytes_sent``, copies and parity."""
        self.offered = self.sent = self.expired = self.replaced = self.retransmitted = self.bytes_sent = 0
        self.payload_sent = 0


class Inbound:
    """Counters of a topic at its receiver, since the session object was made; names as in `stats.TopicStats`."""

    __slots__ = (
        "_arrival", "_delay", "_delay_in_order", "bytes_delivered", "delay", "delay_error", "delivered", "duplicate",
        "expired", "jitter", "jitter_in_order", "late", "lost", "period", "superseded",
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
        self._arrival = math.nan
        self._delay = math.nan
        self._delay_in_order = math.nan

    def arrived(self, delay: float, error: float, in_order: bool, now: float) -> None:
        """Take the times of one authentic message; ``error`` is inf while the clock offset is unknown."""
        if self._arrival == self._arrival:
            self.period.add(now - self._arrival)
        self._arrival = now
        if error == math.inf:
            return
        self.delay.add(delay)
        if not error <= self.delay_error:
            self.delay_error = error
        if self._delay == self._delay:
            self.jitter.add(abs(delay - self._delay))
        self._delay = delay
        if in_order:
            if self._delay_in_order == self._delay_in_order:
                self.jitter_in_order.add(abs(delay - self._delay_in_order))
            self._delay_in_order = delay


class Mean:
    """Running mean."""

    __slots__ = ("_count", "_sum")

    def __init__(self) -> None:
        self._sum = 0.0
        self._count = 0

    def add(self, value: float) -> None:
        """Take one value."""
        self._sum += value
        self._count += 1

    @property
    def value(self) -> float:
        """NaN if there are no values."""
        return self._sum / self._count if self._count else math.nan
