"""One path of a session: addresses, packet numbers, pacing, redundancy, and what is known of losses and delays on it.

Which of several paths is used when is decided in `paths`.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Hashable
from typing import NamedTuple

from ..codec.frames import MOST_ASTRAY, MOST_RUN, Feedback
from ..config import Config
from ..fec.loss import LossEstimate, Sums
from ..fec.redundancy import Redundancy
from ..measure.histogram import Histogram
from .congestion import RateControl
from .liveness import Liveness
from .mtu import MtuSearch
from .pacer import Pacer
from .path_estimators import NUMBERS, DelayMeter, LossMeter
from .path_validation import PathValidation

SETTLE = 0.15
"""Seconds between evaluations of losses: what comes later than that after its successors counts as lost."""
MUCH = 48
"""Packets after which the peer is told of them without waiting for the next ping."""
MUCH_AT_FIRST = 8
"""The same on a path not known well yet: that it is too slow for the first bursts should be known before the next."""
UNKNOWN = 8e6, 0.08
"""Bits per second until a burst was seen, and share of a ceiling that is higher than usual: on a slow link a first
frame at full speed would be a queue of its length."""
BURST_TIME = 0.03
"""Seconds in which it arrives, beyond a round trip until the peer has told so."""
PACE_TIME = 1.0
"""Seconds that the number of packets sent in a second is averaged over."""
ASTRAY_TIME = 2 * SETTLE
"""Seconds for which the peer is told of packets that went to other addresses."""
FAMILIAR = 500
"""Packets from which a path is known well."""
OWN_DELAY = 0.05
"""Most seconds for which packets may wait for this end without that counting as a queue on the path: what waits longer
fills the system's buffer, so the peer has to slow down."""


class Transmit(NamedTuple):
    """What is to be sent to one address: a datagram, or several of ``segment`` bytes (the last may be shorter)."""

    path: int
    address: Hashable
    data: memoryview | bytes
    segment: int | None


class Path:
    """State of one path at one end."""

    __slots__ = (
        "_arrived_at", "_assumed_loss", "_astray", "_cautious", "_fed_back_at", "_known", "_pace", "_settle_at",
        "_singles", "address", "bytes_received", "bytes_sent", "control", "cost", "delays", "echo", "heard_at", "id",
        "large", "liveness", "loss_in", "loss_out", "losses", "mtu", "newest", "next_number", "pacer",
        "packets_received", "packets_sent", "peer", "ping_at", "pinged_at", "redundancy", "rtt", "rtts", "validation",
    )  # fmt: skip

    def __init__(self, path_id: int, config: Config, now: float) -> None:
        self.id = path_id
        self.cost = 0
        """The robot's preference: of paths that are as good as each other the cheapest is used."""
        self.peer: Hashable | None = None
        """Where the robot's end was told that the service is."""
        self.address: Hashable | None = None
        """Where to send; None while unknown. Follows the peer once it has answered there (see `path_validation`)."""
        self.validation = PathValidation()
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
        self.control = RateControl(config.rate_bps, now)
        self._known = False
        """Whether the peer has told what became of a burst."""
        self._cautious = max(min(config.rate_bps, UNKNOWN[0]), config.rate_bps * UNKNOWN[1])
        self.pacer = Pacer(self._cautious, max(config.mtu, config.max_mtu), config.burst, now)
        self.next_number = 0
        self.packets_sent = self.packets_received = self.bytes_sent = self.bytes_received = 0
        self.rtt = math.nan
        self.rtts = Histogram()
        self.redundancy = Redundancy(config)
        self._assumed_loss = config.assumed_loss
        self._arrived_at = now
        self._singles = 0
        """Packets sent one by one since the last feedback."""
        self._pace = math.inf
        self._astray: deque[tuple[int, int, float]] = deque(maxlen=MOST_ASTRAY)
        """Packets that went to other addresses, as runs: the first, how many, when the last was sent."""
        self._measure(now)

    def _measure(self, now: float) -> None:
        """From the beginning: another peer, or the same one after a restart, counts anew."""
        self.losses, self.delays = LossMeter(), DelayMeter()
        self.loss_in = LossEstimate(self._assumed_loss)
        """Of what arrives here; ``loss_out`` of what the peer says has arrived there."""
        self.loss_out = LossEstimate(self._assumed_loss)
        self._fed_back_at = now
        self._settle_at = now

    def comes(self, size: int, packets: int, now: float, waited: float) -> None:
        """So many bytes in so many packets are here, of which `arrived` or `arrived_all` tells more.

        They ``waited`` for this end to look: a busy machine is no slow path, unless it cannot keep up.
        """
        self.bytes_received += size
        self.packets_received += packets
        self._arrived_at = now - min(waited, OWN_DELAY)

    def arrived(self, number: int, time: int, size: int) -> None:
        """A packet of ``size`` bytes came; ``time`` is that of its sending in ticks."""
        self.losses.add(number, time)
        self.delays.add(number, time, size, self._arrived_at)

    def arrived_all(self, numbers: bytes, times: bytes, size: int) -> None:
        """Several packets came: native unsigned 32-bit numbers, 16-bit times."""
        self.losses.add_all(numbers, times)
        self.delays.add_all(numbers, times, size, self._arrived_at)

    @property
    def much_arrived(self) -> bool:
        """Whether the peer should be told before the next ping is due."""
        return self.delays.pending >= (MUCH if self.losses.settled > FAMILIAR else MUCH_AT_FIRST)

    def feedback(self, now: float) -> Feedback:
        """What the peer is to know; evaluates what arrived."""
        losses, delays = self.losses, self.delays
        if now >= self._settle_at:
            losses.evaluate()
            self._settle_at = now + SETTLE
        delays.evaluate(now)
        sums = Sums(losses.settled, losses.lost, losses.runs, losses.time, losses.time_squared)
        self.loss_in.update(sums, now)
        return Feedback(delays.capacity, delays.queue, delays.rate, losses.settled, losses.lost, losses.runs, *sums[3:])

    def apply_feedback(self, feedback: Feedback, now: float) -> None:
        """Follow what the peer knows."""
        new = self.loss_out.update(Sums(*feedback[3:]), now)
        self.redundancy.model = self.loss_out.model.rounded()
        elapsed = now - self._fed_back_at
        if elapsed <= 0:
            return
        self._fed_back_at = now
        self._follow_pace(self._singles / elapsed, elapsed)
        self._singles = 0
        used, waited = self.pacer.usage()
        if now >= self.pacer.burst_at + self.rtts.minimum + BURST_TIME:
            self._known = True
        waited = waited and self._known
        self.control.update(feedback, new.settled, new.lost, used * 8 / elapsed, waited, self.rtt, now)
        self.pacer.set_rate(self.control.rate if self._known else min(self.control.rate, self._cautious))

    def _follow_pace(self, pace: float, elapsed: float) -> None:
        if self._pace == math.inf:
            self._pace = pace
        self._pace += (1 - math.exp(-elapsed / PACE_TIME)) * (pace - self._pace)
        # Rounded down by up to a third, so that plans are made once.
        self.redundancy.pace = 1.5 ** math.floor(math.log(max(self._pace, 1.0), 1.5))

    def shared(self, batches: list[Transmit]) -> list[Transmit]:
        """Copies for addresses where the peer may be, as far as they may have them."""
        copies = []
        for batch in batches:
            for address, size in self.validation.allowances(len(batch.data), batch.segment):
                segment = batch.segment if batch.segment is not None and size > batch.segment else None
                copies.append(Transmit(self.id, address, batch.data[:size], segment))
                self.bytes_sent += size
        return copies

    def number(self, count: int = 1) -> int:
        """Claim packet numbers; returns the first."""
        first = self.next_number
        self._singles += count == 1
        self.next_number = (first + count) % NUMBERS
        self.packets_sent += count
        return first

    def number_astray(self, now: float) -> int:
        """The same of one packet that goes to another address than the path's, where the peer need not be.

        It is told not to wait for it: who makes an end try other addresses would make both believe in loss.
        """
        number = self.number()
        if self._astray:
            first, count, _ = self._astray[-1]
            if (first + count) % NUMBERS == number and count < MOST_RUN:
                self._astray[-1] = first, count + 1, now
                return number
        self._astray.append((number, 1, now))
        return number

    def astray(self, now: float) -> tuple[tuple[int, int], ...]:
        """Those of late, as runs: first number, and how many."""
        while self._astray and now - self._astray[0][2] > ASTRAY_TIME:
            self._astray.popleft()
        return tuple((first, count) for first, count, _ in self._astray)

    def start_epoch(self, now: float) -> None:
        """Forget what belongs to a peer that was there before."""
        self.newest = -1
        self.echo = None
        self.validation.clear()
        self._measure(now)
        self.liveness = Liveness()
        self.mtu.restart(now)
        self.ping_at = now
