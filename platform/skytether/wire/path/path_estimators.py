"""What the packets that arrive tell of a path: losses with their bursts, and delays with the queue behind them.

Packet numbers and times of sending of authentic packets are collected as they come and evaluated from time to time, as
arrays. The peer may be hostile or begin anew: what lies far from the rest is ignored.
"""

from __future__ import annotations

import math
from array import array
from collections import deque
from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from ..codec.packet import TICK, TICKS

NUMBERS = 2**32

COLLECT = 65_536
"""Packets held before they are evaluated early: 384 KiB."""


class LossMeter:
    """Losses and their bursts from packet numbers, as sums since the first packet.

    Each number is evaluated one `evaluate` late, so that reordered packets are not taken for lost ones.
    """

    PLAUSIBLE = 65_536
    """Numbers further from the middle of an interval's numbers are ignored."""
    MOST_ASTRAY = 256
    """Runs of numbers that were not sent here, kept until they are evaluated."""

    __slots__ = (
        "_astray", "_in_run", "_numbers", "_settled", "_span", "_times", "lost", "runs", "settled", "time",
        "time_squared",
    )  # fmt: skip

    def __init__(self) -> None:
        self._numbers = array("I")
        self._times = array("H")
        self._settled: int | None = None
        """Highest number evaluated, not wrapped."""
        self._span = 0
        """Numbers above ``_settled`` that had been seen at the last evaluation."""
        self._in_run = False
        """Whether the highest number evaluated was lost."""
        self._astray: dict[int, int] = {}
        """By the first number, how many in a row were sent elsewhere."""
        self.settled = 0
        """Packets known to have been sent."""
        self.lost = 0
        self.runs = 0
        """Runs of lost packets."""
        self.time = 0.0
        """Seconds from the first to the last packet of each run, summed."""
        self.time_squared = 0.0

    def add(self, number: int, time: int) -> None:
        """A packet arrived; its time of sending is in ticks."""
        self._numbers.append(number)
        self._times.append(time)
        if len(self._numbers) >= COLLECT:
            self._evaluate_early()

    def add_all(self, numbers: bytes, times: bytes) -> None:
        """Several packets arrived: native unsigned 32-bit numbers, 16-bit times."""
        self._numbers.frombytes(numbers)
        self._times.frombytes(times)
        if len(self._numbers) >= COLLECT:
            self._evaluate_early()

    def leave_out(self, runs: Iterable[tuple[int, int]]) -> None:
        """The peer sent packets elsewhere: first numbers, and how many in a row. Those are neither here nor lost."""
        for first, count in runs:
            self._astray[first] = max(count, self._astray.pop(first, 0))
            if len(self._astray) > self.MOST_ASTRAY:
                del self._astray[next(iter(self._astray))]

    def _evaluate_early(self) -> None:
        self.evaluate()
        self.evaluate()  # nothing is kept for the next time

    def evaluate(self) -> None:
        """Settle what had arrived by the last evaluation."""
        if not self._numbers:
            return
        numbers = np.frombuffer(self._numbers, np.uint32).astype(np.int64)
        times = np.frombuffer(self._times, np.uint16)
        start = int(numbers[0]) if self._settled is None else self._settled % NUMBERS
        offsets = (numbers - start + NUMBERS // 2) % NUMBERS - NUMBERS // 2  # they wrap after 2**32 packets
        middle = np.partition(offsets, len(offsets) // 2)[len(offsets) // 2]
        near = np.abs(offsets - middle) < self.PLAUSIBLE
        offsets, times = offsets[near], times[near]
        highest = int(offsets.max())
        if self._settled is None or not -self.PLAUSIBLE < highest < 2 * self.PLAUSIBLE:
            # The first time, or after a silence too long to say anything about the share of packets lost.
            lowest = int(offsets.min()) - 1
            self._settled, self._span, self._in_run = start + lowest, highest - lowest, False
        else:
            if self._span:
                settled = (offsets > 0) & (offsets <= self._span)
                self._settle(offsets[settled], times[settled])
            later = offsets > self._span
            offsets, times = offsets[later], times[later]
            self._settled, self._span = start + self._span, max(0, highest - self._span)
        self._numbers = array("I", ((offsets + start) % NUMBERS).astype(np.uint32).tobytes())
        self._times = array("H", times.tobytes())

    def _counting(self, span: int) -> npt.NDArray[np.bool_]:
        """Which of the next numbers were sent here; what is known of numbers before them is forgotten."""
        counts = np.ones(span, bool)
        start = 0 if self._settled is None else self._settled
        for first, count in list(self._astray.items()):
            begin = (first - start + NUMBERS // 2) % NUMBERS - NUMBERS // 2 - 1  # the first of the next has offset 1
            counts[max(0, begin) : max(0, begin + count)] = False
            if begin + count <= 0:
                del self._astray[first]
        return counts

    def _settle(self, offsets: npt.NDArray[np.int64], times: npt.NDArray[np.uint16]) -> None:
        """Count the next ``_span`` numbers, of which these arrived."""
        span = self._span
        arrived = np.zeros(span, bool)
        arrived[offsets - 1] = True
        if self._astray:
            counts = self._counting(span) | arrived
            offsets = np.cumsum(counts, dtype=np.int64)[offsets - 1]
            arrived = arrived[counts]
            span = len(arrived)
            if not span:
                return
        self.settled += span
        lost = span - int(np.count_nonzero(arrived))
        if not lost:
            self._in_run = False
            return
        self.lost += lost
        self.runs += int(not arrived[0] and not self._in_run) + int(np.count_nonzero(~arrived[1:] & arrived[:-1]))
        self._in_run = not arrived[-1]
        if len(offsets) > 1:
            # A lost packet was sent between those that arrived before and after it, in even steps.
            offsets, first = np.unique(offsets, return_index=True)
            gaps = np.diff(offsets)
            elapsed = np.mod(np.diff(times[first].astype(np.int64)), TICKS) * TICK * (gaps - 2) / gaps
            runs = elapsed[gaps > 2]
            self.time += float(runs.sum())
            self.time_squared += float((runs * runs).sum())


class DelayMeter:
    """The queue on a path, and the rate that drains it, from one-way delays.

    The clocks of both ends are unknown, so only differences of delays are used. What is learnt of them:

    - `queue`: how much longer a packet takes now than at the best time of late. Of each interval's packets the
      quarter that was fastest counts, so that a burst that drains before the next is no queue.
    - `capacity`: if the path were drained at some rate, a burst would wait behind itself by a delay that can be
      computed (Lindley 1952). Of a range of rates, the one whose delays fit those measured best is what the path
      has; jitter fits none better than another and is averaged out. Rates that the evidence does not refute remain
      possible; where even no limit at all is possible, the capacity is infinite.
    """

    RATES = 1e5 / 8 * 1.12 ** np.arange(82)
    """Rates considered, bytes per second: 0.1 Mbit/s to 1 Gbit/s."""
    MEMORY = 1.5
    """Seconds after which evidence counts a third."""
    REFUTED = 16.0
    """Twice the log likelihood ratio from which a limit is believed to be there (a false alarm in 16,000)."""
    CERTAIN = 40.0
    """Evidence beyond this is not collected, so that it is forgotten in time."""
    LOOK = 6.0
    """Most evidence that one look adds: a pause of a machine on the way is no slow link, however late it makes what
    arrives. Looks that agree make a limit."""
    POSSIBLE = 8.0
    """Twice the log likelihood ratio up to which a higher rate is preferred to the best."""
    FIRST = 3
    """Looks at a burst for which that does not hold: the first frame should not fill a queue until others agree."""
    STEADY = 0.002
    """Standard deviation of delays up to which it does not."""
    BURST = 8000
    """Bytes of such a burst."""
    QUIET = 0.0003
    """Standard deviation of delays that is taken for granted: timers, batches."""
    BASE_TIME = 30.0
    """Seconds that the shortest delay is remembered: clocks drift, routes change."""
    LOOKS = 2
    """Looks at least that see a queue before it is one: it stands, a pause of a machine is over at the next look."""
    STANDING = 0.08
    """Seconds for which all looks have to see it."""
    QUARTERS = 13
    """Intervals whose levels tell how much a level varies by itself."""
    RATE_TIME = 0.2
    """Seconds that the rate of arrival is averaged over: some frames of a camera."""
    MOST = 512
    """Packets of an interval that are looked at one by one; of more, groups."""
    LEAST = 6
    """Packets that say anything about a queue."""
    JITTERY = 0.015
    """Three standard deviations from which packets may overtake each other by much."""
    LEAST_OF_JITTER = 48
    """The same where delays vary by more than a queue does."""

    __slots__ = (
        "_arrivals", "_backlog", "_base", "_bursts", "_bytes", "_evidence", "_last", "_level", "_looks", "_noise",
        "_numbers", "_quarters", "_reference", "_sizes", "_times", "_updated", "capacity", "pending", "queue", "rate",
    )  # fmt: skip

    def __init__(self) -> None:
        self._numbers = array("I")
        self._times = array("H")
        self._sizes = array("H")
        self._arrivals = array("d")
        self._bytes = 0
        self._reference: int | None = None
        """Arrival minus sending of the first packet, in ticks."""
        self._last = -math.inf
        """When the last packet evaluated was sent."""
        self._backlog = np.zeros(len(self.RATES))
        """Bytes waiting at that time if the path had each of the rates."""
        self._evidence = np.zeros(len(self.RATES) + 1)
        """Against each of the rates, and against no limit."""
        self._bursts = 0
        """Looks at bursts, as far as they count."""
        self._noise = math.nan
        """Variance of delays that no queue explains."""
        self._level = math.nan
        self._quarters: deque[float] = deque(maxlen=self.QUARTERS)
        self._base: deque[tuple[float, float]] = deque()
        """Candidates for the lowest level of the next `BASE_TIME`: time and level, both rising."""
        self._looks: deque[tuple[float, float]] = deque()
        """Time and level of the looks of the last `STANDING`."""
        self._updated = math.nan
        self.capacity = math.inf
        """Highest rate that is possible, bits per second."""
        self.queue = 0.0
        """Seconds that packets wait, as far as it is more than chance."""
        self.rate = 0.0
        """Bits per second that arrived."""
        self.pending = 0
        """Packets that came since the last evaluation."""

    def add(self, number: int, time: int, size: int, now: float) -> None:
        """A packet of ``size`` bytes arrived; its time of sending is in ticks."""
        self._numbers.append(number)
        self._times.append(time)
        self._sizes.append(size)
        self._bytes += size
        self.pending += 1
        self._arrivals.append(now)
        if len(self._times) >= COLLECT:
            self.evaluate(now)

    def add_all(self, numbers: bytes, times: bytes, size: int, now: float) -> None:
        """Several equal packets arrived: native unsigned 32-bit numbers, 16-bit times."""
        count = len(times) // 2
        self._numbers.frombytes(numbers)
        self._times.frombytes(times)
        self._sizes.extend([size] * count)
        self._bytes += size * count
        self.pending += count
        self._arrivals.extend([now] * count)
        if len(self._times) >= COLLECT:
            self.evaluate(now)

    def evaluate(self, now: float) -> None:
        """Bring the results up to date; packets that may be overtaken yet wait for the next time."""
        elapsed, self._updated = now - self._updated, now
        self.pending = 0
        self._evidence *= math.exp(-elapsed / self.MEMORY) if elapsed > 0 else 1.0
        if self._times:
            self._evaluate_arrivals(now)
        if elapsed > 0:
            self.rate += (1 - math.exp(-elapsed / self.RATE_TIME)) * (self._bytes * 8 / elapsed - self.rate)
            self._bytes = 0
        best = float(self._evidence.min())
        self._evidence = np.minimum(self._evidence - best, self.CERTAIN)
        if self._evidence[-1] < self.REFUTED:
            self.capacity = math.inf
        else:
            self.capacity = float(self.RATES[np.flatnonzero(self._evidence[:-1] <= self.POSSIBLE)[-1]]) * 8

    def _evaluate_arrivals(self, now: float) -> None:
        numbers = np.frombuffer(self._numbers, np.uint32)
        times = np.frombuffer(self._times, np.uint16).astype(np.float64)
        sizes = np.frombuffer(self._sizes, np.uint16).astype(np.float64)
        arrivals = np.frombuffer(self._arrivals, np.float64)
        transit = np.mod(arrivals / TICK - times, TICKS)
        if self._reference is None:
            self._reference = int(transit[0])
        delays = (np.mod(transit - self._reference + TICKS / 2, TICKS) - TICKS / 2) * TICK
        # Whole ticks: what was sent at once is equal, and has the order of its numbers.
        sent = np.rint((arrivals - delays) / TICK) * TICK
        spread = 0.0 if math.isnan(self._noise) else 3 * math.sqrt(self._noise)
        jittery = spread > self.JITTERY
        ready = sent <= sent.max() - (min(spread, 0.1) if jittery and len(sent) < COLLECT else 0.0)
        if np.count_nonzero(ready) < (self.LEAST_OF_JITTER if jittery else self.LEAST):
            return
        keep = ~ready
        self._numbers = array("I", numbers[keep].tobytes())
        self._times = array("H", times[keep].astype(np.uint16).tobytes())
        self._sizes = array("H", sizes[keep].astype(np.uint16).tobytes())
        self._arrivals = array("d", arrivals[keep].tobytes())
        ready &= sent > self._last - TICK / 2  # a burst has one time of sending
        if np.count_nonzero(ready) < 2:
            return
        order = np.lexsort(((numbers[ready] - numbers[0]).astype(np.int32), sent[ready]))
        sent, delays, total = sent[ready][order], delays[ready][order], np.cumsum(sizes[ready][order])
        if len(sent) > self.MOST:
            step = -(-len(sent) // self.MOST)
            sent, delays, total = sent[step - 1 :: step], delays[step - 1 :: step], total[step - 1 :: step]
        self._weigh(sent, delays, total)
        self._measure(delays, now)

    def _weigh(
        self, sent: npt.NDArray[np.float64], delays: npt.NDArray[np.float64], total: npt.NDArray[np.float64]
    ) -> None:
        """Compare the delays with those that each rate would make."""
        rates = self.RATES[:, None]
        before = self._last if self._last > -math.inf else sent[0]
        drained = total - rates * (sent - before)
        sizes = np.diff(total, prepend=0.0)
        empty = np.minimum(np.minimum.accumulate(drained - sizes, axis=1), -self._backlog[:, None])
        backlog = drained - empty
        self._backlog, self._last = backlog[:, -1], float(sent[-1])
        unexplained = np.vstack([delays - backlog / rates, delays])
        unexplained -= unexplained.mean(axis=1, keepdims=True)
        squares = np.einsum("ij,ij->i", unexplained, unexplained)
        noise = max(float(squares.min()) / (len(sent) - 1), self.QUIET**2)
        self._noise = noise if math.isnan(self._noise) else self._noise + 0.2 * (noise - self._noise)
        squares /= max(self._noise, noise)
        most = self.LOOK
        if self._bursts < self.FIRST and total[-1] >= self.BURST:
            self._bursts += 1
            if max(self._noise, noise) < self.STEADY**2:
                most = self.CERTAIN
        self._evidence += np.minimum(squares - squares.min(), most)

    def _measure(self, delays: npt.NDArray[np.float64], now: float) -> None:
        """The level of the fastest quarter, against the lowest of late."""
        count = len(delays)
        quarter = float(np.partition(delays, count // 4)[count // 4])
        error = 1.36 * math.sqrt(self._noise / count)  # of a normal distribution's first quartile
        self._quarters.append(quarter)
        if len(self._quarters) == self.QUARTERS:
            # Jitter that keeps the order is not independent from packet to packet: how intervals differ tells more.
            changes = np.sort(np.abs(np.diff(np.array(self._quarters), 2)))
            # Their median, twice. NumPy's own loads a package at its first use: 20 ms of a session's first second.
            error = max(error, float(changes[(len(changes) - 1) // 2] + changes[len(changes) // 2]))
        looks = self._looks
        looks.append((now, quarter))
        while len(looks) > self.LOOKS and looks[1][0] <= now - self.STANDING:
            looks.popleft()
        lowest = min(level for _, level in looks)
        weight = 0.3 if error > 0.001 else 1.0
        self._level = lowest if math.isnan(self._level) else self._level + weight * (lowest - self._level)
        base = self._base
        while base and base[-1][1] >= self._level:
            base.pop()
        base.append((now, self._level))
        while base[0][0] < now - self.BASE_TIME:
            base.popleft()
        self.queue = max(0.0, self._level - base[0][1] - 4 * error)
