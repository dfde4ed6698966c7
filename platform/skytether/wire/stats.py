"""Quality of service as it is told to others (rule 11): plain snapshots, no live state."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class TopicStats:
    """One topic in one direction. Counters count messages since the session object was made, over all its peers.

    They add up: ``published == refused + offered``, ``offered == sent + dropped``,
    ``sent == delivered + superseded + lost + unsettled``.

    Sender's counters are exact at the sender and as of its last report at the receiver, and the other
    way round; times are in seconds, NaN where nothing was measured yet.
    """

    topic: str
    direction: str
    priority: int
    refused: int = 0
    """Handed to ``publish``, which returned False, for there was no session, or the peer has no such topic. Known at
    the sender only."""
    offered: int = 0
    """Handed to ``publish`` while connected; on reliable topics at any time."""
    sent: int = 0
    """First shard handed to the network."""
    delivered: int = 0
    """Complete and authentic at the receiver, and given to its graph."""
    lost: int = 0
    """Sent, never completed: gaps in the topic's sequence that are older than its lifespan (of a reliable topic: that
    the sender gave up). When nothing is under way any more, ``sent == delivered + superseded + lost + unknown``."""
    unknown: int = 0
    """Sent to a peer before it was restarted, which had not said what became of them (not of reliable topics: there
    they are sent again)."""
    late: int = 0
    """Arrived after having been counted lost; subtracted from ``lost`` again, the only counter that goes down: use
    ``lost + late`` where none may."""
    expired: int = 0
    """Dropped for age in the sender's queue or on its way out, or partly arrived and dropped in the receiver's
    reassembly (those are among the lost too)."""
    replaced: int = 0
    """Dropped in the sender's queue because newer ones filled it; of a reliable topic of more depth than 1: refused
    because it was full of messages that are not acknowledged."""
    retransmitted: int = 0
    """Packets of a reliable topic sent again because nobody acknowledged them in time."""
    superseded: int = 0
    """Arrived complete after a newer one of a newest-value topic; neither lost nor delivered."""
    duplicate: int = 0
    """Shards of messages that were already complete (what redundancy cost where nothing was lost)."""
    bytes_sent: int = 0
    """On the wire, headers and redundancy included, IP and UDP headers not."""
    bytes_delivered: int = 0
    """Payload."""
    delay_p50: float = float("nan")
    """One-way, from ``publish`` at the sender to delivery, in seconds."""
    delay_p99: float = float("nan")
    delay_max: float = float("nan")
    delay_error: float = float("nan")
    """Bound of the clock offset's error behind the delays."""
    jitter: float = float("nan")
    """Mean absolute difference of successive one-way delays (RFC 3550 section 6.4.1), by arrival."""
    jitter_in_order: float = float("nan")
    """The same over messages that arrived in sequence only: jitter without reordering."""
    period_p50: float = float("nan")
    """Time between arrivals."""
    period_p99: float = float("nan")

    @property
    def published(self) -> int:
        """Handed to ``publish``, whatever became of it."""
        return self.refused + self.offered

    @property
    def dropped(self) -> int:
        """Taken, and not sent: too old, too many (`expired`, `replaced`), or waiting now."""
        return max(0, self.offered - self.sent)

    @property
    def unsettled(self) -> int:
        """Sent, and nobody told what became of it: under way, or `unknown`."""
        return max(0, self.sent - self.delivered - self.superseded - self.lost)


@dataclass(frozen=True, slots=True)
class PathStats:
    """One path of a session, as this end sees it."""

    path: int
    address: object
    rtt: float = float("nan")
    """Latest round trip without the peer's hold time, seconds."""
    rtt_min: float = float("nan")
    rtt_p50: float = float("nan")
    loss_out: float = float("nan")
    """Share of packets sent that did not arrive, reported by the peer."""
    loss_in: float = float("nan")
    """Share of packets sent by the peer that did not arrive here."""
    burst_in: float = float("nan")
    """Mean length of a run of lost packets."""
    burst_out: float = float("nan")
    packets_sent: int = 0
    packets_received: int = 0
    bytes_sent: int = 0
    bytes_received: int = 0
    rate: float = float("nan")
    """Pacing budget, bits per second."""
    overhead: float = float("nan")
    """Bytes sent beyond payload, as a share of payload; of all paths together."""
    redundancy: float = float("nan")
    """Bytes of copies and parity, as a share of payload; of all paths together."""
    active: bool = True
    """Whether this end sends by it."""
    health: str = "live"
    """``live``, ``suspect`` (an answer is overdue), ``new`` (none came yet) or ``dead``, for what this end sends. Only
    asked where there are several paths."""
    cost: int = 0
    mtu: int = 0
    """Largest datagram sent by it."""


@dataclass(frozen=True, slots=True)
class SessionStats:
    """Everything one end knows of both directions."""

    connected: bool
    topics: tuple[TopicStats, ...] = ()
    paths: tuple[PathStats, ...] = ()
    rejected: dict[str, int] = field(default_factory=dict)
    """Packets refused, by bounded reason."""
    clock_offset: float = float("nan")
    """Peer's monotonic clock minus ours, seconds."""
    clock_error: float = float("inf")
    handshakes: int = 0
    last_heard: float = float("nan")
    """Seconds since the last authenticated packet."""
    reassembly_bytes: int = 0
    """Memory that messages take which are not complete yet, of handshakes too."""
