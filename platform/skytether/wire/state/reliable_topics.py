"""All reliable topics of a session: what outlives handshakes, what is said about them in frames, and when."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator

from ..codec.frames import MISSING_ROWS, Ack, Forward, Missing, push_ack, push_forward, push_missing
from ..codec.packet import pull_number
from ..measure.rtt import RttEstimator
from ..reliable.reliable_sender import Inbox, Outbox
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
        wake: Called with an outbox that has something to send and is not queued.
    """

    def __init__(
        self, role: Role, topics: Iterable[Topic], limit: int, counters: TopicCounters, wake: Callable[[Outbox], None]
    ) -> None:
        self._limit = limit
        self._wake = wake
        self.rtt = RttEstimator()
        self._ours = {t.name for t in topics if t.reliable and t.direction.sender is role}
        self._outboxes = {
            t.name: Outbox(t, counters.outbound(t.name), self.rtt) for t in topics if t.name in self._ours
        }
        self._inboxes: dict[str, Inbox] = {}
        self._busy: set[Outbox] = set()
        """Outboxes that may have a timer."""
        self._owing: set[Inbox] = set()
        """Inboxes that may have to acknowledge something."""
        self._life = b""
        """The peer's."""
        self._receiving: list[ReceiveTopic] = []

    @property
    def due(self) -> float:
        """When to call `handle_timer`."""
        if not self._busy and not self._owing:
            return math.inf
        due = min((outbox.due for outbox in self._busy), default=math.inf)
        return min(due, min((inbox.due for inbox in self._owing), default=math.inf))

    def outbox(self, name: str) -> Outbox | None:
        """Of a topic that is reliable whether there is a session or not."""
        return self._outboxes.get(name)

    def start_epoch(self, epoch: Epoch | None, now: float) -> bool:
        """Use other keys from now on, or none.

        Returns:
            Whether the peer is another than the one before.
        """
        for outbox in self._outboxes.values():
            if epoch is None or outbox.topic.name not in epoch.send:
                outbox.pause()
        self._owing.clear()  # without these keys nothing can be acknowledged; what is missed is sent again
        if epoch is None:
            return False
        newcomer, restarted = epoch.life != self._life, self._life not in (b"", epoch.life)
        self._life = epoch.life
        if newcomer:
            for topic in self._receiving:  # what arrives late under the keys before is of no interest any more
                topic.inbox = None
            self._inboxes.clear()
        self._receiving = [t for t in epoch.receive.values() if t.topic.reliable]
        self._inboxes = {t.name: self._inboxes.get(t.name) or Inbox(self._owing) for t in self._receiving}
        for receive in self._receiving:
            receive.inbox = inbox = self._inboxes[receive.name]
            inbox.start_epoch(receive.index, now)
        sending = {t.name: t for t in epoch.send.values() if t.topic.reliable}
        for name in self._outboxes.keys() - self._ours - sending.keys():
            self._busy.discard(self._outboxes.pop(name))
        for name, send in sending.items():
            send.outbox = outbox = self._outboxes.get(name) or Outbox(send.topic, send.counters, self.rtt)
            self._outboxes[name] = outbox
            outbox.start_epoch(send.index, send.topic, send.counters, now, newcomer)
            self._stir(outbox)
        return restarted

    def put(self, outbox: Outbox, payload: bytes, now: float) -> bool:
        """Take a message to send; False if there is no room for it."""
        outbox.counters.offered += 1
        room = self._limit - sum(o.used for o in self._outboxes.values())
        accepted = outbox.put(payload, now, room)
        self._stir(outbox)
        return accepted

    def resume(self, now: float) -> None:
        """The peer is heard again after a silence."""
        for outbox in list(self._busy):
            outbox.resume(now)
            self._stir(outbox)

    def on_frame(self, message: Ack | Missing, epoch: Epoch, now: float) -> None:
        """The peer tells what it has of what we send."""
        outbox = next((t.outbox for t in epoch.send.values() if t.index == message.topic), None)
        if outbox is None:
            return
        if isinstance(message, Ack):
            outbox.acknowledged(message)
        else:
            outbox.missing(message.number, message.until, message.rows, now)
        self._stir(outbox)

    def handle_timer(self, now: float) -> Iterator[bytes]:
        """Do what is due; yields frames to send."""
        for outbox in list(self._busy):
            if outbox.due <= now:
                outbox.handle_timer(now)
                if outbox.forwarding(now) and outbox.index is not None:
                    yield push_forward(Forward(outbox.index, outbox.base))
            self._stir(outbox)
        for inbox in [i for i in self._owing if i.due <= now]:
            self._owing.discard(inbox)
            yield from _tell(inbox)

    def _stir(self, outbox: Outbox) -> None:
        """Keep watch of an outbox as long as it has something to do."""
        if outbox.ready and not outbox.queued:
            self._wake(outbox)
        if outbox.idle:
            self._busy.discard(outbox)
        else:
            self._busy.add(outbox)


def _tell(inbox: Inbox) -> Iterator[bytes]:
    """An acknowledgement and what is missing of large messages."""
    inbox.due = math.inf
    ack = inbox.acknowledgement()
    if ack is not None:
        yield push_ack(ack)
    entries, inbox.entries = list(inbox.entries.values())[-ACCOUNTS:], {}
    for entry in entries:
        if entry.alive:
            until, rows = entry.gaps(MISSING_ROWS)
            yield push_missing(Missing(inbox.index, pull_number(entry.key[0]), until, tuple(rows)))
