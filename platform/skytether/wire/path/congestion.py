"""Which rate a path is used with (rule 6): below its capacity as far as that is known, with a fair share. Pure.

- The rate is the configured ceiling until delays show a limit. Lost packets do not: a path that loses a third of them
  at random is not congested.
- A measured capacity below the rate takes effect at once, a standing queue takes the rate below what arrives until it
  is drained. Later the rate grows again, by equal steps for everybody and faster with time (as CUBIC's does: RFC
  9438), as long as it is used: that makes sessions on one bottleneck share it.
- Somebody who fills every queue (TCP) would push out who evades queues. If a standing queue does not shrink with our
  rate, it is not ours: then the rate grows by a packet per round trip as TCP's and shrinks when packets are lost in
  that queue, until the queue is gone.
"""

from __future__ import annotations

import math

from ..codec.frames import Feedback

TARGET = 0.002
"""Seconds of standing queue that are tolerated; on a slow path the time of one and a half packets."""
MARGIN = 0.95
"""Share of the measured capacity that is used."""
LOWEST = 200e3
"""Bits per second that are always allowed."""
PACKET = 9600.0
"""Bits of a packet: the unit of growth."""
STEP = 10 * PACKET
"""Growth in bits per second per second, soon after a reduction."""
HASTE = 2.0
"""Seconds without a reduction after which growth is twice as fast; five times as fast after double that time."""
DOUBLE = 2.0
"""Growth in a second of a rate that only bursts (a camera's frames) make full use of, while delays do not grow."""
FAR = 0.4
"""Share of the capacity, if one was measured, below which a rate used without pause grows like that too."""
STEADY = 0.05
"""Most growth in a second, as a share of the rate, up to where there was a queue: the next is noticed after 0.2 s."""
NEAR = 0.05
"""Share of the rate at which there was a queue that counts as near: there the growth is the slowest."""
SLOW = 0.01
"""Growth there in a second, as a share of the rate."""
SATURATED = 0.7
"""Share of the rate used from which a path is taken to be used without pause."""
USED_TIME = 0.3
"""Seconds that the rate used is averaged over: some frames of a camera."""
BURSTS = 2.0
"""Bursts may have this multiple of the mean rate that arrives whatever the capacity seems to be: jitter that keeps the
order of packets spreads a burst as a slow link does."""
KEEP = 0.9
"""What remains of the rate that arrives through a standing queue: the decrease that shares a bottleneck."""
SMOOTH = 1.2
"""The same for a path that is not used without pause: then it is no more than bursts that make the queue."""
DRAIN = 0.08
"""Seconds in which a standing queue is drained, at the most of half the rate."""
REST = 0.3
"""Seconds beyond a round trip after which a reduction must have shown."""
FOREIGN = 0.02
"""Seconds of a standing queue that may be somebody else's; a smaller one is left to be drained."""
PATIENCE = 2.0
"""Seconds for which a standing queue may withstand our reductions before it is taken for somebody else's, and for
which there must be none before that is over."""
CALM = 1.0
"""Seconds without a queue after which losses are not by a full one."""
USUAL = 5000.0
"""Packets over which the share lost without a queue is averaged."""
YIELD = 0.5
"""What remains of the rate after losses in somebody else's queue, as of TCP's window (RFC 5681)."""


START = 50e6
"""Bits per second that a path is first used with, if the ceiling allows; half of a ceiling that is higher than twice
that, for who configures it knows the path."""


class RateControl:
    """Rate of one path.

    Attributes:
        rate: Bits per second.
        competing: Whether the queue on the path is somebody else's.
    """

    __slots__ = (
        "_before", "_calm_since", "_ceiling", "_cut_at", "_drain", "_foreign_since", "_full", "_hold", "_share",
        "_updated", "_used", "_usual", "competing", "rate",
    )  # fmt: skip

    def __init__(self, ceiling: float, now: float) -> None:
        self._ceiling = ceiling
        self._share = self.rate = max(min(ceiling, START), ceiling / 2)
        self._drain = math.inf
        """Rate until the queue is gone."""
        self.competing = False
        self._updated = self._cut_at = now
        self._full = 0.0
        """Rate at which there was a queue."""
        self._hold = -math.inf
        """No reduction for queue or loss before this: those made have not shown yet."""
        self._calm_since = now
        self._foreign_since = math.inf
        self._before = ceiling
        """Rate before a queue was there that may be somebody else's."""
        self._used = 0.0
        self._usual = 0.0, 0.0
        """Packets and losses without a queue, those of late counting more."""

    def update(
        self, feedback: Feedback, settled: float, lost: float, used: float, waited: bool, rtt: float, now: float
    ) -> None:
        """Take the peer's feedback.

        Args:
            feedback: What it knows.
            settled: Packets newly known to have arrived or to be lost.
            lost: Those that are lost.
            used: Bits per second sent since the last feedback.
            waited: Whether anything waited because of the rate since then.
            rtt: Round trip, seconds; NaN if unknown.
            now: Time.
        """
        elapsed = min(now - self._updated, 0.5)
        self._updated = now
        self._used += (1 - math.exp(-elapsed / USED_TIME)) * (used - self._used)
        rtt = min(max(rtt, 0.01), 1.0) if rtt == rtt else 0.1
        self._watch(feedback, now)
        before = self._share
        overflown = self._beyond_usual(settled, lost, now)
        if self.competing:
            growth = PACKET / rtt**2
            if overflown and now >= self._hold:
                self._share *= YIELD
                self._hold = now + rtt + REST
        else:
            growth = self._growth(feedback, now)
            self._evade(feedback, rtt, now)
        if self._share < before:
            self._cut_at = now
        elif waited and (self.competing or self._share < MARGIN * feedback.capacity):
            self._share += growth * elapsed
        self._share = min(max(self._share, LOWEST), self._ceiling)
        self.rate = min(self._share, max(self._drain, LOWEST))

    def _growth(self, feedback: Feedback, now: float) -> float:
        """Bits per second per second by which the rate may grow."""
        near = abs(self._share - self._full) < NEAR * self._full
        free = self._used < SATURATED * self.rate or self._share < FAR * feedback.capacity
        if free and not self._queued(feedback):
            return math.log(DOUBLE) * self._share
        if near:
            self._cut_at = now
            return max(STEP / 2, SLOW * self._share)
        growth = STEP * (1 + ((now - self._cut_at) / HASTE) ** 2)
        return min(growth, max(STEP, STEADY * self._share)) if self._share < self._full else growth

    def _evade(self, feedback: Feedback, rtt: float, now: float) -> None:
        """Keep below the capacity, and without a queue."""
        queued, saturated = self._queued(feedback), self._used >= SATURATED * self.rate
        limit = MARGIN * feedback.capacity
        if not queued:
            # A rate that is used without pause and makes no queue is no more than the capacity, whatever that seems.
            self._drain = math.inf
            limit = max(limit, self._share if saturated else BURSTS * feedback.rate)
            if limit < self._share:
                self._full = min(feedback.capacity, self._share)
                self._hold = now + rtt + REST  # what waits by now is not the new rate's queue
        elif now >= self._hold:
            self._hold = now + rtt + REST
            self._full = min(feedback.capacity, self._share)
            if limit > KEEP * self._share:  # not a queue that was made before the capacity was known
                self._full = max(feedback.rate, self._share / 2)
                limit = KEEP * min(self._share, max(feedback.rate, self._share / 2))
            if not saturated:  # smoother bursts, but no less
                limit = max(limit, SMOOTH * feedback.rate)
        else:
            limit = self._share
        self._share = min(self._share, limit)
        if queued:
            self._drain = self._share * (1 - min(feedback.queue / DRAIN, 0.5))

    def _beyond_usual(self, settled: float, lost: float, now: float) -> bool:
        """Whether more packets were lost than the path loses without congestion."""
        packets, losses = self._usual
        if now - self._calm_since > CALM:
            fading = 1 - min(settled / USUAL, 1.0)
            self._usual = packets * fading + settled, losses * fading + lost
            return False
        expected = settled * losses / packets if packets else 0.0
        return lost > expected + 3 * math.sqrt(expected)

    def _queued(self, feedback: Feedback) -> bool:
        return feedback.queue > max(TARGET, 1.5 * PACKET / self._share)

    def _watch(self, feedback: Feedback, now: float) -> None:
        """Find out whose queue it is."""
        queue = feedback.queue
        self._calm_since = math.inf if self._queued(feedback) else min(self._calm_since, now)
        if queue <= FOREIGN:
            self._foreign_since = math.inf
        elif self._foreign_since == math.inf:
            self._foreign_since = now
            if not self.competing:
                self._before = min(self._share, SMOOTH * feedback.rate)
        if self.competing:
            self.competing = now - self._calm_since < PATIENCE
        elif now - self._foreign_since >= PATIENCE:
            self.competing = True
            self._share, self._drain = max(self._share, self._before), math.inf
