"""Counters by topic, ours and those the peer reports: both ends know both directions (rule 11)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

from .control import ReceiverRow, Report, SenderRow
from .epoch import Epoch, ReceiveTopic, SendTopic
from .measure import Inbound, Outbound
from .stats import TopicStats
from .topic import Role, Topic

ROWS_PER_REPORT = 100
"""Rows of each kind sent at one time; larger tables take turns."""


class Ledger:
    """Outlives epochs: counters go on while a peer restarts. Bounded by the tables of both ends."""

    def __init__(self, role: Role) -> None:
        self._role = role
        self._out: dict[str, Outbound] = {}
        self._in: dict[str, Inbound] = {}
        self._peer_out: dict[str, SenderRow] = {}
        self._peer_in: dict[str, ReceiverRow] = {}
        self._turn = 0

    def outbound(self, name: str) -> Outbound:
        """Counters of a topic that this end sends."""
        return self._out.setdefault(name, Outbound())

    def topics(self, agreed: Iterable[tuple[int, Topic]]) -> tuple[list[SendTopic], list[ReceiveTopic]]:
        """State of an epoch's topics, on the counters they always had."""
        send, receive = [], []
        for index, topic in agreed:
            if topic.direction.sender is self._role:
                send.append(SendTopic(index, topic, self.outbound(topic.name)))
            else:
                receive.append(ReceiveTopic(index, topic, self._in.setdefault(topic.name, Inbound())))
        return send, receive

    def start_epoch(self, epoch: Epoch) -> None:
        """Forget topics that a peer before had and this one has not, and what that peer reported."""
        names = {t.name for t in epoch.topics}
        for counters in (self._out, self._in):
            for name in counters.keys() - names:
                del counters[name]
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

    def take(self, report: Report, epoch: Epoch, now: float) -> None:
        """Take what the peer reports."""
        for row in report.senders:
            receiver = epoch.receive.get(row.topic)
            if receiver is not None:
                receiver.tracker.sent(row.used, now)
                receiver.settle(now)
                self._peer_out[receiver.name] = row
        names = {t.index: t.name for t in epoch.send.values()}
        for receiver_row in report.receivers:
            if receiver_row.topic in names:
                self._peer_in[names[receiver_row.topic]] = receiver_row

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
                bytes_sent=out.bytes_sent, retransmitted=out.retransmitted,
            )  # fmt: skip
            row = self._peer_in.get(topic.name)
            if row is None:
                return base
            return replace(
                base, delivered=row.delivered, lost=row.lost, late=row.late, expired=out.expired + row.expired,
                superseded=row.superseded, duplicate=row.duplicate, bytes_delivered=row.bytes_delivered,
                delay_p50=row.delay_p50, delay_p99=row.delay_p99, delay_max=row.delay_max, delay_error=row.delay_error,
                jitter=row.jitter, jitter_in_order=row.jitter_in_order, period_p50=row.period_p50,
                period_p99=row.period_p99,
            )  # fmt: skip
        c = self._in.get(topic.name, Inbound())
        c.settle()
        base = replace(
            base, delivered=c.delivered, lost=c.lost, late=c.late, expired=c.expired, superseded=c.superseded,
            duplicate=c.duplicate, bytes_delivered=c.bytes_delivered, delay_p50=c.delay.quantile(0.5),
            delay_p99=c.delay.quantile(0.99), delay_max=c.delay.maximum, delay_error=c.delay_error,
            jitter=c.jitter.value, jitter_in_order=c.jitter_in_order.value, period_p50=c.period.quantile(0.5),
            period_p99=c.period.quantile(0.99),
        )  # fmt: skip
        sender = self._peer_out.get(topic.name)
        if sender is None:
            return base
        return replace(
            base, offered=sender.offered, sent=sender.sent, expired=c.expired + sender.expired,
            replaced=sender.replaced, bytes_sent=sender.bytes_sent, retransmitted=sender.retransmitted,
        )  # fmt: skip


def _in_turn(rows: list[SendTopic] | list[ReceiveTopic], turn: int) -> list:  # type: ignore[type-arg]
    if len(rows) <= ROWS_PER_REPORT:
        return rows
    start = turn * ROWS_PER_REPORT % len(rows)
    return (rows[start:] + rows[:start])[:ROWS_PER_REPORT]
