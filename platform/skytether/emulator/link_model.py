"""What a link does to each packet, decided with made-up or real time: no socket, no clock.

The sockets around it are in `link`. A link is two `LinkModel`, one for each direction.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from math import inf
from random import Random

IP_UDP_HEADERS = 28
"""Bytes that every datagram costs on an IPv4 link besides its payload."""


@dataclass(frozen=True, slots=True)
class LinkConditions:
    """One direction of a link. The default is a perfect one.

    Attributes:
        delay: One way, seconds.
        jitter: Standard deviation of the delay in seconds: normal, cut off at 3 deviations and at zero delay.
        jitter_reorders: False: jitter delays packets but never lets one overtake another.
        loss: Share of packets lost, 0 to 1.
        burst: Mean length of a run of lost packets (Gilbert-Elliott); None: each packet is lost by itself.
        rate: Bits per second of IP packets; None: without limit.
        queue: Bytes that may wait in front of the rate limit; what does not fit is dropped.
        reorder: Share of packets that are held back by `reorder_by`, so that later ones overtake them.
        reorder_by: Seconds.
        duplicate: Share of packets that arrive twice.
        cut: Nothing arrives, what is under way included.
        seed: Of all chances; conditions that differ in other fields only go on with the same series.
    """

    delay: float = 0.0
    jitter: float = 0.0
    jitter_reorders: bool = True
    loss: float = 0.0
    burst: float | None = None
    rate: float | None = None
    queue: int = 128 * 1024
    reorder: float = 0.0
    reorder_by: float = 0.005
    duplicate: float = 0.0
    cut: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuse what no link can be.

        Raises:
            ValueError: A field is out of its range; the text names the field and the range.
        """
        for name in ("delay", "jitter", "reorder_by"):
            if not 0 <= getattr(self, name) <= 60:
                raise ValueError(f"link: {name} must be 0 to 60 s, not {getattr(self, name)}")
        for name in ("loss", "reorder", "duplicate"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"link: {name} must be 0 to 1, not {getattr(self, name)}")
        if self.rate is not None and not self.rate > 0:
            raise ValueError(f"link: rate must be above 0 bit/s, not {self.rate}")
        if self.queue < 0:
            raise ValueError(f"link: queue must be at least 0 bytes, not {self.queue}")
        if self.burst is not None:
            if not 1 <= self.burst < inf:
                raise ValueError(f"link: burst must be at least 1 packet and finite, not {self.burst}")
            most = self.burst / (1 + self.burst)
            if self.loss > most:
                raise ValueError(
                    f"link: loss must be 0 to {most:.3g} with bursts of {self.burst:g} packets, not {self.loss}"
                )


@dataclass(slots=True)
class LinkCounters:
    """What one direction of a link did, in packets unless said otherwise."""

    received: int = 0
    bytes_received: int = 0
    """As counted by the caller of `LinkModel.decide`."""
    forwarded: int = 0
    """Copies included."""
    bytes_forwarded: int = 0
    lost: int = 0
    overflowed: int = 0
    """Found the queue in front of the rate limit full."""
    cut: int = 0
    reordered: int = 0
    duplicated: int = 0
    failed: int = 0
    """The system refused to send it on."""
    late_total: float = 0.0
    """Seconds that packets left after the time decided, summed: the emulator's own error."""
    late_max: float = 0.0

    def copy(self) -> LinkCounters:
        """A snapshot."""
        return LinkCounters(**{f.name: getattr(self, f.name) for f in fields(self)})


class LinkModel:
    """One direction of a link: says when each packet arrives, if at all.

    Attributes:
        conditions: May be replaced at any time, from any thread; holds from the next packet on. Packets that wait in
            front of a rate limit keep the times decided for them.
        counters: What was decided.
    """

    def __init__(self, conditions: LinkConditions, direction: str) -> None:
        self.conditions = conditions
        self.counters = LinkCounters()
        self._direction = direction
        self._applied: LinkConditions | None = None
        self._random = Random()
        self._in_burst = False
        self._queue_free_at = -inf
        self._last_arrival = -inf

    def decide(self, size: int, now: float) -> tuple[float, ...]:
        """When a packet that enters the link now leaves it.

        Args:
            size: Bytes of UDP payload.
            now: Seconds; never before the previous packet's.

        Returns:
            Nothing if it is lost, one time, or two if it is duplicated.
        """
        conditions = self.conditions
        if conditions is not self._applied:
            self._apply(conditions, now)
        counters = self.counters
        counters.received += 1
        counters.bytes_received += size
        if conditions.cut:
            counters.cut += 1
            return ()
        if conditions.rate is None:
            leaves = now
        else:
            start = max(now, self._queue_free_at)
            bits = (size + IP_UDP_HEADERS) * 8
            if (start - now) * conditions.rate + bits > conditions.queue * 8 and start > now:
                counters.overflowed += 1
                return ()
            leaves = self._queue_free_at = start + bits / conditions.rate
        if conditions.loss and self._is_lost(conditions):
            counters.lost += 1
            return ()
        arrival = self._arrival(leaves, conditions)
        if conditions.duplicate and self._random.random() < conditions.duplicate:
            counters.duplicated += 1
            return arrival, self._arrival(leaves, conditions)
        return (arrival,)

    def _apply(self, conditions: LinkConditions, now: float) -> None:
        before = self._applied.rate if self._applied is not None else None
        # What waits in the queue waits on, but is sent at the new rate; a link without a limit has no queue.
        if before is not None:
            waiting = max(self._queue_free_at - now, 0.0) * before
            self._queue_free_at = now + (waiting / conditions.rate if conditions.rate is not None else 0.0)
        if self._applied is None or self._applied.seed != conditions.seed:
            # The direction is part of the seed, or both directions would lose the same packets.
            self._random = Random(f"{conditions.seed} {self._direction}")
        if self._applied is None or (self._applied.loss, self._applied.burst) != (conditions.loss, conditions.burst):
            self._in_burst = conditions.burst is not None and self._random.random() < conditions.loss
        self._applied = conditions

    def _is_lost(self, conditions: LinkConditions) -> bool:
        """Independent, or the Gilbert-Elliott chain that has this loss and this mean run in the bad state."""
        if conditions.burst is None:
            return self._random.random() < conditions.loss
        lost = self._in_burst
        leave_bad = 1 / conditions.burst
        if lost:
            self._in_burst = self._random.random() >= leave_bad
        else:
            enter_bad = leave_bad * conditions.loss / (1 - conditions.loss)
            self._in_burst = self._random.random() < enter_bad
        return lost

    def _arrival(self, leaves: float, conditions: LinkConditions) -> float:
        delay = conditions.delay
        if conditions.jitter:
            most = 3 * conditions.jitter
            delay += min(max(self._random.gauss(0, conditions.jitter), -min(delay, most)), most)
        arrival = leaves + delay
        if not conditions.jitter_reorders:
            arrival = max(arrival, self._last_arrival)
            self._last_arrival = arrival
        if conditions.reorder and self._random.random() < conditions.reorder:
            self.counters.reordered += 1
            arrival += conditions.reorder_by
        return arrival
