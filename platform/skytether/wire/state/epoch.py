"""What one handshake made: keys, message numbers, the agreed topics and the state that ends with them."""

from __future__ import annotations

import math
from collections import deque

from ..codec.ciphers import Ciphers
from ..codec.replay_window import PacketWindow, ReplayWindow
from ..config import MAX_REKEY_BYTES
from ..measure.counters import Inbound, Outbound
from ..measure.sequence import SequenceTracker
from ..reliable.reliable_receiver import ReliableReceiver
from ..reliable.reliable_sender import ReliableSender
from ..topic import Direction, PathUse, Topic

CONTROL = Topic("control", "control", Direction.IN, lifespan=1.0, depth=64, delivery=0.9, paths=PathUse.REDUNDANT)
"""Pings, reports and goodbye: sealed and numbered like a topic, both ways."""
CONTROL_PRIORITY = 128
"""Above every topic's."""

MAX_BYTES = 2 * MAX_REKEY_BYTES
"""Nothing more is sent under the same keys: twice what a new handshake is asked for at."""

Waiting = tuple[bytes, float, int | None]
"""Payload, time of publishing, extra packets (None: as the redundancy policy says)."""


class SendTopic:
    """A topic that this end sends, during one epoch."""

    __slots__ = (
        "counters", "delivery", "depth", "index", "lifespan", "name", "priority", "ready", "redundant",
        "reliable_sender", "sequence", "topic", "waiting",
    )  # fmt: skip

    def __init__(self, index: int, topic: Topic, counters: Outbound, priority: int | None = None) -> None:
        self.index = index
        self.topic = topic
        self.name = topic.name
        self.priority = topic.priority if priority is None else priority
        self.lifespan = topic.lifespan
        self.depth = topic.depth
        self.delivery = topic.delivery
        self.redundant = topic.paths is PathUse.REDUNDANT
        self.counters = counters
        self.waiting: deque[Waiting] = deque()
        self.reliable_sender: ReliableSender | None = None
        """Of a reliable topic, as long as its epoch is in use."""
        self.ready = False
        """Whether the send queue has it in its heap."""
        self.sequence = 0
        """Of the next message to leave the queue."""


class ReceiveTopic:
    """A topic that the peer sends, during one epoch."""

    __slots__ = (
        "counters", "index", "lifespan", "name", "newest", "newest_only", "reliable_receiver", "settled", "topic",
        "tracker",
    )  # fmt: skip

    def __init__(self, index: int, topic: Topic, counters: Inbound) -> None:
        self.index = index
        self.topic = topic
        self.name = topic.name
        self.lifespan = topic.lifespan
        self.newest_only = topic.depth == 1
        self.reliable_receiver: ReliableReceiver | None = None
        """Of a reliable topic, as long as its peer is the one in use."""
        self.newest = -1
        """Highest sequence that arrived."""
        self.tracker = SequenceTracker(topic.lifespan)
        self.settled = 0
        """Losses of the tracker that are in the counters."""
        self.counters = counters

    def arrived(self, sequence: int, size: int, delay: float, error: float, outdated: bool, now: float) -> bool:
        """Take an authentic message, once.

        Args:
            sequence: Its topic sequence.
            size: Bytes of payload.
            delay: Seconds on its way; meaningless if ``error`` is inf.
            error: Bound of the delay's error.
            outdated: A newer one of a later epoch was here before.
            now: Time of arrival.

        Returns:
            Whether to deliver it; else it is superseded.
        """
        counters = self.counters
        if self.tracker.observe(sequence, now):
            counters.late += 1
            self._count_lost()  # together, so that lost and late added up never go down
        in_order = sequence > self.newest
        if in_order:
            self.newest = sequence
        counters.arrived(delay, error, in_order, now)
        if self.newest_only and (outdated or not in_order):
            counters.superseded += 1
            return False
        counters.delivered += 1
        counters.bytes_delivered += size
        return True

    def delivered(self, size: int, delay: float, error: float, now: float) -> None:
        """Count a message of a reliable topic that is its turn; parameters as of `arrived`."""
        self.counters.arrived(delay, error, True, now)
        self.counters.delivered += 1
        self.counters.bytes_delivered += size

    def settle(self, now: float) -> None:
        """Bring the counters' losses up to date."""
        if self.reliable_receiver is not None:
            self.counters.lost += self.reliable_receiver.skipped
            self.reliable_receiver.skipped = 0
        self.counters.settle()
        self.tracker.settle(now)
        self._count_lost()

    def _count_lost(self) -> None:
        self.counters.lost += self.tracker.lost - self.settled
        self.settled = self.tracker.lost


class Epoch:
    """The state that a handshake begins and the next one ends."""

    __slots__ = (
        "_packets", "bytes_received", "bytes_sent", "ciphers", "heard_at", "id", "life", "next_number", "receive",
        "replay", "send", "topics",
    )  # fmt: skip

    def __init__(
        self,
        epoch_id: int,
        ciphers: Ciphers,
        topics: tuple[Topic, ...],
        send: list[SendTopic],
        receive: list[ReceiveTopic],
        life: bytes,
    ) -> None:
        self.id = epoch_id
        """One byte that tells it from those before and after."""
        self.ciphers = ciphers
        self.next_number = 0
        """Of the next message sealed, whatever its topic: the nonce."""
        self.replay = ReplayWindow()
        self._packets: dict[int, PacketWindow] = {}
        self.heard_at = -math.inf
        """When the last packet came that was new."""
        self.bytes_sent = self.bytes_received = 0
        self.topics = topics
        self.life = life
        """The peer's (see `handshake`)."""
        self.send = {t.name: t for t in send}
        self.receive = {t.index: t for t in receive}

    def packets(self, path: int) -> PacketWindow:
        """Packet numbers that arrived by that path; to be asked about authentic packets only."""
        window = self._packets.get(path)
        if window is None:
            window = self._packets[path] = PacketWindow()
        return window

    @property
    def spent(self) -> bool:
        """Whether nothing more may be sent under these keys."""
        return self.bytes_sent >= MAX_BYTES

    @property
    def volume(self) -> int:
        """Bytes in the direction that has more."""
        return max(self.bytes_sent, self.bytes_received)

    def belongs_with(self, other: Epoch | None) -> bool:
        """Whether both are of the same two ends and topics, with nothing between them but new keys."""
        return other is not None and self.receive is other.receive

    def take_over(self, before: Epoch) -> bool:
        """Go on where other keys end: same topics, numbers and counters. False: the peer is another, or has others."""
        if before.life != self.life or before.topics != self.topics:
            return False
        self.send, self.receive = before.send, before.receive
        self.next_number = before.next_number
        # What confirmed these keys was accepted just now: going back would take its copies for new ones.
        self.replay.highest = max(self.replay.highest, before.replay.highest)
        return True
