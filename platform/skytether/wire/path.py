"""One path of a session: addresses, packet numbers, pacing, and what is known of losses on it.

Which of several paths is used when is decided in `paths`.
"""

from __future__ import annotations

import math
from array import array
from collections import deque
from collections.abc import Hashable
from typing import NamedTuple

import numpy as np

from .config import Config
from .liveness import Liveness
from .measure import Histogram
from .mtu import MtuSearch
from .pacer import Pacer

NUMBERS = 2**32


class Transmit(NamedTuple):
    """What is to be sent to one address: a datagram, or several of ``segment`` bytes (the last may be shorter)."""

    path: int
    address: Hashable
    data: memoryview | bytes
    segment: int | None


class LossMeter:
    """Losses and their bursts from packet numbers.

    Numbers are collected as they come and evaluated from time to time, each one `evaluate` late, so that
    reordered packets are not taken for lost ones. They are not authenticated: what lies far from the rest is
    ignored.
    """

    PLAUSIBLE = 65_536
    """Numbers further from the middle of an interval's numbers are ignored."""
    COLLECT = 65_536
    """Numbers held before they are evaluated early: 256 KiB."""
    WINDOW = 20
    """Evaluations that the shares are taken over: 10 s with the default report interval."""

    __slots__ = ("_history", "_numbers", "_settled", "_span")

    def __init__(self) -> None:
        self._numbers = array("I")
        self._settled: int | None = None
        """Highest number evaluated, not wrapped."""
        self._span = 0
        """Numbers above ``_settled`` that had been seen at the last evaluation."""
        self._history: deque[tuple[int, int, int]] = deque(maxlen=self.WINDOW)
        """Received, lost, runs of lost ones."""

    def add(self, number: int) -> None:
        """A packet arrived."""
        self._numbers.append(number)
        if len(self._numbers) >= self.COLLECT:
            self._evaluate_early()

    def add_all(self, numbers: bytes) -> None:
        """Several packets arrived: native unsigned 32-bit numbers."""
        self._numbers.frombytes(numbers)
        if len(self._numbers) >= self.COLLECT:
            self._evaluate_early()

    def _evaluate_early(self) -> None:
        self.evaluate()
        self.evaluate()  # nothing is kept for the next time

    def evaluate(self) -> None:
        """Settle what had arrived by the last evaluation."""
        if not self._numbers:
            return
        numbers = np.frombuffer(self._numbers, np.uint32).astype(np.int64)
        start = int(numbers[0]) if self._settled is None else self._settled % NUMBERS
        offsets = (numbers - start + NUMBERS // 2) % NUMBERS - NUMBERS // 2  # they wrap after 2**32 packets
        middle = np.partition(offsets, len(offsets) // 2)[len(offsets) // 2]
        offsets = offsets[np.abs(offsets - middle) < self.PLAUSIBLE]
        highest = int(offsets.max())
        if self._settled is None or not -self.PLAUSIBLE < highest < 2 * self.PLAUSIBLE:
            # The first time, or after a silence too long to say anything about the share of packets lost.
            lowest = int(offsets.min()) - 1
            self._settled, self._span = start + lowest, highest - lowest
        else:
            if self._span:
                arrived = np.zeros(self._span, bool)
                arrived[offsets[(offsets > 0) & (offsets <= self._span)] - 1] = True
                lost = ~arrived
                runs = int(lost[0]) + int(np.count_nonzero(lost[1:] & ~lost[:-1]))
                count = int(np.count_nonzero(arrived))
                self._history.append((count, self._span - count, runs))
            offsets = offsets[offsets > self._span]
            self._settled, self._span = start + self._span, max(0, highest - self._span)
        self._numbers = array("I", ((offsets + start) % NUMBERS).astype(np.uint32).tobytes())

    @property
    def loss(self) -> float:
        """Share of packets lost; NaN before the first evaluation."""
        lost = sum(h[1] for h in self._history)
        total = lost + sum(h[0] for h in self._history)
        return lost / total if total else math.nan

    @property
    def burst(self) -> float:
        """Mean length of a run of lost packets; NaN if none was lost."""
        runs = sum(h[2] for h in self._history)
        return sum(h[1] for h in self._history) / runs if runs else math.nan


class Path:
    """State of one path at one end."""

    __slots__ = (
        "address", "arrivals", "burst_out", "bytes_received", "bytes_sent", "cost", "echo", "heard_at", "id", "large",
        "liveness", "loss_out", "mtu", "newest", "next_number", "pacer", "packets_received", "packets_sent", "peer",
        "ping_at", "pinged_at", "rtt", "rtts",
    )  # fmt: skip

    def __init__(self, path_id: int, config: Config, now: float) -> None:
        self.id = path_id
        self.cost = 0
        """The robot's preference: of paths that are as good as each other the cheapest is used."""
        self.peer: Hashable | None = None
        """Where the robot's end was told that the service is."""
        self.address: Hashable | None = None
        """Where to send; None while unknown. Follows the peer's authentic messages."""
        self.newest = -1
        """Highest number of an authentic message of this epoch that came by this path."""
        self.heard_at = now
        self.echo: tuple[float, float] | None = None
        """Peer's latest time stamp that came by this path, and when it arrived."""
        self.ping_at = math.inf
        self.pinged_at = -math.inf
        self.liveness = Liveness()
        self.mtu = MtuSearch(config.mtu, config.max_mtu)
        self.large = False
        """Whether packets of the largest size were sent since the last look."""
        self.pacer = Pacer(config.rate_bps, max(config.mtu, config.max_mtu), config.burst, now)
        self.next_number = 0
        self.arrivals = LossMeter()
        self.packets_sent = self.packets_received = self.bytes_sent = self.bytes_received = 0
        self.loss_out = math.nan
        """Reported by the peer, as is ``burst_out``."""
        self.burst_out = math.nan
        self.rtt = math.nan
        self.rtts = Histogram()

    def number(self, count: int = 1) -> int:
        """Claim packet numbers; returns the first."""
        first = self.next_number
        self.next_number = (first + count) % NUMBERS
        self.packets_sent += count
        return first

    def start_epoch(self, now: float) -> None:
        """Forget what belongs to a peer that was there before."""
        self.newest = -1
        self.echo = None
        self.arrivals = LossMeter()
        self.loss_out = self.burst_out = math.nan
        self.liveness = Liveness()
        self.mtu.restart(now)
        self.ping_at = now
