"""Counters of a topic at its two ends: what quality of service is computed from (rule 11)."""

from __future__ import annotations

import math
from array import array

import numpy as np

from .histogram import Histogram, Values

_COLLECT = 512
"""Arrivals held before they are counted: 16 KiB of each topic."""
_NONE: Values = np.empty(0)


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
