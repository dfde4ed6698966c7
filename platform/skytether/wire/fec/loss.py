"""What redundancy has to reckon with: how many packets a path loses, and how they cluster. Pure.

Made from the sums that a `LossMeter` counts: at the receiver for its statistics, at the sender from
the peer's feedback.
"""

from __future__ import annotations

import math
from typing import NamedTuple

SLOW = 10.0
"""Seconds after which a loss counts a third: rare losses are remembered through many clean seconds."""
FAST = 1.0
"""The same for noticing that a path got worse."""
DOUBT = 40.0
"""Packets that the loss assumed for an unknown path counts for."""
CONVINCED = 150.0
"""Packets after which that assumption counts a third."""


class LossModel(NamedTuple):
    """Losses as a chain of two states (Gilbert 1960): after a lost packet the next is more likely to be lost."""

    loss: float
    """Share of packets lost; rather too high than too low."""
    burst: float = 1.0
    """Mean number of packets in a run of losses; 1 if each is lost by itself."""
    time: float = 0.0
    """Mean seconds that such a run goes on."""

    def rounded(self) -> LossModel:
        """The same in few digits, so that plans are made once: loss up to the next 10 %, the others 25 %."""
        return LossModel(_up(self.loss, 0.1), _up(self.burst, 0.25), _up(self.time, 0.25))


def _up(value: float, step: float) -> float:
    return math.exp(math.ceil(math.log(value) / step - 1e-9) * step) if value > 0 else 0.0


class Sums(NamedTuple):
    """Packets settled, lost, runs of lost ones, and the runs' durations (and their squares) in seconds."""

    settled: float = 0
    lost: float = 0
    runs: float = 0
    time: float = 0.0
    time_squared: float = 0.0


class LossEstimate:
    """Follows a path's losses: up within a second, down slowly.

    Args:
        assumed: Share of packets lost on a path not seen before.
    """

    __slots__ = ("_assumed", "_fast", "_seen", "_slow", "_total", "_updated")

    def __init__(self, assumed: float) -> None:
        self._assumed = assumed
        self._total: Sums | None = None
        self._slow = self._fast = Sums()
        self._seen = 0.0
        """Packets, ever."""
        self._updated = 0.0

    def update(self, total: Sums, now: float) -> Sums:
        """Take sums since the beginning; the first three may wrap at 2**32.

        Returns:
            What is new in them.
        """
        before = self._total if self._total is not None else Sums()
        settled, lost, runs = (int(a - b) % 2**32 for a, b in zip(total[:3], before[:3], strict=True))
        new = Sums(
            settled, lost, runs, max(0.0, total.time - before.time), max(0.0, total.time_squared - before.time_squared)
        )
        if new.lost > new.settled or new.settled >= 2**31:  # an older report than the one before
            return Sums()
        elapsed = max(0.0, now - self._updated) if self._total is not None else 0.0
        self._total, self._updated = total, now
        self._seen += new.settled
        self._slow = _decayed(self._slow, new, elapsed / SLOW)
        self._fast = _decayed(self._fast, new, elapsed / FAST)
        return new

    @property
    def share(self) -> float:
        """Share of packets lost of late; NaN if none is known."""
        return self._slow.lost / self._slow.settled if self._slow.settled else math.nan

    @property
    def burst(self) -> float:
        """Mean number of packets in a run of lost ones; NaN if none was lost."""
        return self._slow.lost / self._slow.runs if self._slow.runs > 0 else math.nan

    @property
    def model(self) -> LossModel:
        """What to reckon with."""
        slow, fast = self._slow, self._fast
        doubt = DOUBT * math.exp(-self._seen / CONVINCED)
        lost, settled = slow.lost + self._assumed * doubt, slow.settled + doubt
        if not settled:
            return LossModel(0.0)
        loss = (lost + math.sqrt(slow.lost)) / settled
        if fast.lost > 2:  # what recent packets show beyond chance
            loss = max(loss, (fast.lost - math.sqrt(fast.lost)) / fast.settled)
        if loss * settled < 0.1:  # the last loss is long ago
            loss = 0.0
        loss = min(loss, 0.9)
        if slow.runs <= 0:
            return LossModel(loss)
        burst, alone = slow.lost / slow.runs, 1 / (1 - min(slow.lost / slow.settled, 0.9))
        # Runs of packets lost independently have the mean 1 / (1 - p) and the variance p / (1 - p)**2.
        chance = 3 * alone * math.sqrt((1 - 1 / alone) / max(slow.runs, 1.0))
        if burst <= 1.1 * alone + chance:
            return LossModel(loss)
        # Weighted by their length, as a moment in time meets them; twice the mean for exponential ones.
        time = slow.time_squared / slow.time / 2 if slow.time > 0 else 0.0
        return LossModel(loss, burst, time)


def _decayed(sums: Sums, new: Sums, age: float) -> Sums:
    weight = math.exp(-age)
    return Sums(*(weight * old + fresh for old, fresh in zip(sums, new, strict=True)))
