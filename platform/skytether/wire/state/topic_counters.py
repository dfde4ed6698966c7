"""Counters by topic, ours and those the peer reports: both ends know both directions (rule 11)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

from ..codec.frames import ReceiverRow, Report, SenderRow
from ..measure.counters import Inbound, Outbound
from ..stats import TopicStats
from ..topic import Role, Topic
from .epoch import Epoch, ReceiveTopic, SendTopic

ROWS_PER_REPORT = 100
"""Rows of each kind sent at one time; larger tables take turns."""


_SENT = ("offered", "sent", "expired", "replaced", "retransmitted", "bytes_sent")
_RECEIVED = ("delivered", "lost", "late", "expired", "superseded", "duplicate", "bytes_delivered")
"""Counters of the peer's rows; the rest of them are indices and times."""


class TopicCounters:
    """Outlives epochs and peers: no counter goes down when a peer restarts. Bounded by the tables of both ends."""

    def __init__(self, role: Role) -> None:
        self._role = role
        self._out: dict[str, Outbound] = {}
        self._in: dict[str, Inbound] = {}
        self._peer_out: dict[str, SenderRow] = {}
        self._peer_in: dict[str, ReceiverRow] = {}
        self._life = b""
        """The peer's, which those rows are of."""
        self._past_out: dict[str, Counter[str]] = {}
        self._past_in: dict[str, Counter[str]] = {}
        """What peers before had reported last, summed."""
        self._refused: Counter[str] = Counter()
        """Of topics in our own table, whatever the peer has of it."""
        self._turn = 0

    def refuse(self, name: str) -> None:
        """A message of this topic was not taken: there is no session, or it does not have the topic."""
        self._refused[name] += 1

    def outbound(self, name: str) -> Outbound:
        """Counters of a topic that this end sends."""
        return self._out.setdefault(name, Outbound())

    def topics(self, agreed: Iterable[tuple[int, Topic]]) -> tuple[list[SendTopic], list[ReceiveTopic]]:
        """State of an epoch's topics, on the counters they always had."""
        send, receive = [], []
        for index, topic in agreed:
            if topic.direction.sender is self._role:
                counters = self.outbound(topic.name)
                counters.reliable = topic.reliable
                send.append(SendTopic(index, topic, counters))
            else:
                receive.append(ReceiveTopic(index, topic, self._in.setdefault(topic.name, Inbound())))
        return send, receive

    def start_epoch(self, epoch: Epoch) -> None:
        """Keep what a peer before had reported, and forget topics that it had and this one has not."""
        if epoch.life != self._life:
            self._keep_past()
            self._life = epoch.life
        names = {t.name for t in epoch.topics}
        for kept in (self._out, self._in, self._peer_out, self._peer_in, self._past_out, self._past_in):
            for name in kept.keys() - names:
                del kept[name]

    def _keep_past(self) -> None:
        """The peer was restarted and counts anew; what it did not report before is known to nobody."""
        for name, sent in self._peer_out.items():
            self._past_out.setdefault(name, Counter()).update({f: getattr(sent, f) for f in _SENT})
        for name, received in self._peer_in.items():
            self._past_in.setdefault(name, Counter()).update({f: getattr(received, f) for f in _RECEIVED})
        for name, out in self._out.items():
            if not out.reliable:  # what is not acknowledged of a reliable topic is sent again
                past = self._past_in.setdefault(name, Counter())
                told = past["delivered"] + past["superseded"] + past["lost"] + past["unknown"]
                past["unknown"] += max(0, out.sent - told)
        self._peer_out.clear()
        self._peer_in.clear()

    def rows(self, epoch: Epoch, now: float) -> tuple[list[SenderRow], list[ReceiverRow]]:
        """What to report to the peer."""
        senders, receivers = list(epoch.send.values()), list(epoch.receive.values())
        self._turn += 1
        return (
            [self._sender_row(t) for t in _in_turn(senders, self._turn)],
            [self._receiver_row(t, now) for t in _in_turn(receivers, self._turn)],
        )

    def apply_report(self, report: Report, epoch: Epoch, now: float) -> None:
        """Take what the peer reports; of reports that overtook each other, the newest stays."""
        current = epoch.life == self._life
        for row in report.senders:
            receiver = epoch.receive.get(row.topic)
            if receiver is not None:
                receiver.tracker.sent(row.used, now)
                receiver.settle(now)
                before = self._peer_out.get(receiver.name)
                if current and (before is None or _age(row, _SENT) >= _age(before, _SENT)):
                    self._peer_out[receiver.name] = row
        names = {t.index: t.name for t in epoch.send.values()}
        for receiver_row in report.receivers:
            name = names.get(receiver_row.topic)
            if current and name is not None:
                known = self._peer_in.get(name)
                if known is None or _age(receiver_row, _RECEIVED) >= _age(known, _RECEIVED):
                    self._peer_in[name] = receiver_row

    def stats(self, table: Mapping[str, Topic]) -> tuple[TopicStats, ...]:
        """One row for each topic of a table."""
        return tuple(self._stats(topic) for topic in table.values())

    def overhead(self) -> tuple[float, float]:
        """Bytes sent beyond payload, and those of copies and parity, as shares of payload; NaN if nothing was sent."""
        payload = sum(c.payload_sent for c in self._out.values())
        if not payload:
            return float("nan"), float("nan")
        redundant = sum(c.bytes_redundant for c in self._out.values())
        return sum(c.bytes_sent for c in self._out.values()) / payload - 1, redundant / payload

    @staticmethod
    def _sender_row(topic: SendTopic) -> SenderRow:
        c = topic.counters
        return SenderRow(
            topic.index, topic.sequence, c.offered, c.sent, c.expired, c.replaced, c.retransmitted, c.bytes_sent
        )

    @staticmethod
    def _receiver_row(topic: ReceiveTopic, now: float) -> ReceiverRow:
        topic.settle(now)
        c = topic.counters
        return ReceiverRow(
            topic.index, max(c.delivered, 0), max(c.lost, 0), c.late, c.expired, c.superseded, c.duplicate,
            c.bytes_delivered, c.delay.quantile(0.5), c.delay.quantile(0.99), c.delay.maximum, c.delay_error,
            c.jitter.value, c.jitter_in_order.value, c.period.quantile(0.5), c.period.quantile(0.99),
        )  # fmt: skip

    def _stats(self, topic: Topic) -> TopicStats:
        base = TopicStats(topic.name, topic.direction.value, topic.priority)
        if topic.direction.sender is self._role:
            out = self._out.get(topic.name, Outbound())
            base = replace(
                base, offered=out.offered, sent=out.sent, expired=out.expired, replaced=out.replaced,
                bytes_sent=out.bytes_sent, retransmitted=out.retransmitted, refused=self._refused[topic.name],
            )  # fmt: skip
            row, received = self._peer_in.get(topic.name), self._past_in.get(topic.name, _NOTHING)
            counts: dict[str, Any] = {f: received[f] + getattr(row, f, 0) for f in _RECEIVED}
            counts["expired"] += out.expired
            base = replace(base, unknown=received["unknown"], **counts)
            if row is None:
                return base
            return replace(
                base, delay_p50=row.delay_p50, delay_p99=row.delay_p99, delay_max=row.delay_max,
                delay_error=row.delay_error, jitter=row.jitter, jitter_in_order=row.jitter_in_order,
                period_p50=row.period_p50, period_p99=row.period_p99,
            )  # fmt: skip
        c = self._in.get(topic.name, Inbound())
        c.settle()
        sender, sent = self._peer_out.get(topic.name), self._past_out.get(topic.name, _NOTHING)
        sums: dict[str, Any] = {f: sent[f] + getattr(sender, f, 0) for f in _SENT}
        # What arrived was sent, whether or not the sender has said so yet.
        sums["sent"] = max(sums["sent"], c.delivered + c.superseded + c.lost)
        sums["offered"] = max(sums["offered"], sums["sent"])
        sums["expired"] += c.expired
        return replace(
            base, **sums, delivered=c.delivered, lost=c.lost, late=c.late,
            superseded=c.superseded, duplicate=c.duplicate, bytes_delivered=c.bytes_delivered,
            delay_p50=c.delay.quantile(0.5), delay_p99=c.delay.quantile(0.99), delay_max=c.delay.maximum,
            delay_error=c.delay_error, jitter=c.jitter.value, jitter_in_order=c.jitter_in_order.value,
            period_p50=c.period.quantile(0.5), period_p99=c.period.quantile(0.99),
        )  # fmt: skip


_NOTHING: Counter[str] = Counter()


def _age(row: SenderRow | ReceiverRow, counters: tuple[str, ...]) -> int:
    """Grows from row to row of one life: each counter only goes up, but for losses that came late after all."""
    age: int = sum(getattr(row, counter) for counter in counters) + getattr(row, "late", 0)
    return age


def _in_turn(rows: list[SendTopic] | list[ReceiveTopic], turn: int) -> list:  # type: ignore[type-arg]
    if len(rows) <= ROWS_PER_REPORT:
        return rows
    start = turn * ROWS_PER_REPORT % len(rows)
    return (rows[start:] + rows[:start])[:ROWS_PER_REPORT]
