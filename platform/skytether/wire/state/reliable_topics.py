"""All reliable topics of a session: what outlives handshakes, what is said about them in frames, and when."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator

from ..codec.frames import MISSING_ROWS, Ack, Forward, Missing, push_ack, push_forward, push_missing
from ..codec.packet import pull_number
from ..measure.rtt import RttEstimator
from ..reliable.reliable_receiver import ReliableReceiver
from ..reliable.reliable_sender import ReliableSender
from ..topic import Role, Topic
from .epoch import Epoch, ReceiveTopic
from .topic_counters import TopicCounters

ACCOUNTS = 8
"""Large messages of a topic that one acknowledgement may come with; the others are remembered by the sender's timer."""


class ReliableTopics:
    """The reliable topics of one end.

    Args:
        role: Which end.
        topics: Its table: messages of its reliable topics are kept even before a peer was ever there.
        limit: Most payload bytes kept until they are acknowledged.
        counters: Of all topics.

    Attributes:
        woken: Senders that have something to send and are to be queued; whoever calls a method takes them.
    """

    def __init__(
        self,
        role: Role,
        topics: Iterable[Topic],
        limit: int,
        counters: TopicCounters,
    ) -> None:
        self._limit = limit
        self.woken: deque[ReliableSender] = deque()
        self.rtt = RttEstimator()
        self._ours = {t.name for t in topics if t.reliable and t.direction.sender is role}
        self._senders = {
            t.name: ReliableSender(t, counters.outbound(t.name), self.rtt) for t in topics if t.name in self._ours
        }
        self._receivers: dict[str, ReliableReceiver] = {}
        self._busy: set[ReliableSender] = set()
        """Senders that may have a timer."""
        self._owing: set[ReliableReceiver] = set()
        """Receivers that may have to acknowledge something."""
        self._life = b""
        """The peer's."""
        self._receiving: list[ReceiveTopic] = []

    @property
    def due(self) -> float:
        """When to call `handle_timer`."""
        if not self._busy and not self._owing:
            return math.inf
        due = min((sender.due for sender in self._busy), default=math.inf)
        return min(due, min((receiver.due for receiver in self._owing), default=math.inf))

    def sender(self, name: str) -> ReliableSender | None:
        """Of a topic that is reliable whether there is a session or not."""
        return self._senders.get(name)

    def start_epoch(self, epoch: Epoch | None, now: float) -> bool:
        """Use other keys from now on, or none.

        Returns:
            Whether the peer is another than the one before.
        """
        for sender in self._senders.values():
            if epoch is None or sender.topic.name not in epoch.send:
                sender.pause()
        self._owing.clear()  # without these keys nothing can be acknowledged; what is missed is sent again
        if epoch is None:
            return False
        newcomer, restarted = epoch.life != self._life, self._life not in (b"", epoch.life)
        self._life = epoch.life
        if newcomer:
            for topic in self._receiving:  # what arrives late under the keys before is of no interest any more
                topic.reliable_receiver = None
            self._receivers.clear()
        self._receiving = [t for t in epoch.receive.values() if t.topic.reliable]
        self._receivers = {
            t.name: self._receivers.get(t.name) or ReliableReceiver(self._owing) for t in self._receiving
        }
        for receive in self._receiving:
            receive.reliable_receiver = receiver = self._receivers[receive.name]
            receiver.start_epoch(receive.index, now)
        sending = {t.name: t for t in epoch.send.values() if t.topic.reliable}
        for name in self._senders.keys() - self._ours - sending.keys():
            self._busy.discard(self._senders.pop(name))
        for name, send in sending.items():
            send.reliable_sender = sender = self._senders.get(name) or ReliableSender(
                send.topic, send.counters, self.rtt
            )
            self._senders[name] = sender
            sender.start_epoch(send.index, send.topic, send.counters, now, newcomer)
            self._stir(sender)
        return restarted

    def put(self, sender: ReliableSender, payload: bytes, now: float) -> bool:
        """Take a message to send; False if there is no room for it."""
        sender.counters.offered += 1
        room = self._limit - sum(o.used for o in self._senders.values())
        accepted = sender.put(payload, now, room)
        self._stir(sender)
        return accepted

    def resume(self, now: float) -> None:
        """The peer is heard again after a silence."""
        for sender in list(self._busy):
            sender.resume(now)
            self._stir(sender)

    def on_frame(self, message: Ack | Missing, epoch: Epoch, now: float) -> None:
        """The peer tells what it has of what we send."""
        sender = next((t.reliable_sender for t in epoch.send.values() if t.index == message.topic), None)
        if sender is None:
            return
        if isinstance(message, Ack):
            sender.acknowledged(message)
        else:
            sender.missing(message.number, message.until, message.rows, now)
        self._stir(sender)

    def handle_timer(self, now: float) -> Iterator[bytes]:
        """Do what is due; yields frames to send."""
        for sender in list(self._busy):
            if sender.due <= now:
                sender.handle_timer(now)
                if sender.forwarding(now) and sender.index is not None:
                    yield push_forward(Forward(sender.index, sender.base))
            self._stir(sender)
        for receiver in [i for i in self._owing if i.due <= now]:
            self._owing.discard(receiver)
            yield from _acknowledge(receiver)

    def _stir(self, sender: ReliableSender) -> None:
        """Keep watch of a sender as long as it has something to do."""
        if sender.ready and not sender.queued:
            sender.queued = True
            self.woken.append(sender)
        if sender.idle:
            self._busy.discard(sender)
        else:
            self._busy.add(sender)


def _acknowledge(receiver: ReliableReceiver) -> Iterator[bytes]:
    """An acknowledgement and what is missing of large messages."""
    receiver.due = math.inf
    ack = receiver.acknowledgement()
    if ack is not None:
        yield push_ack(ack)
    entries, receiver.entries = list(receiver.entries.values())[-ACCOUNTS:], {}
    for entry in entries:
        if entry.alive:
            until, rows = entry.gaps(MISSING_ROWS)
            yield push_missing(Missing(receiver.index, pull_number(entry.key[0]), until, tuple(rows)))
