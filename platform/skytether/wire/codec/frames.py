"""Codec of frames: what the two ends tell each other beside the topics, each in a sealed message of topic 0."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from typing import NamedTuple

PING = 1
REPORT = 2
GOODBYE = 3
ACK = 4
MISSING = 5
FORWARD = 6

_PING = struct.Struct(">BBBBHQQIfffIIIff")
_ASTRAY = struct.Struct(">IH")
_REPORT = struct.Struct(">BHH")
_SENDER = struct.Struct(">HIQQQQQQ")
_RECEIVER = struct.Struct(">HQQQQQQQffffffff")
_ACK = struct.Struct(">BHQ")
_MISSING = struct.Struct(">BHQH")
_MISSING_ROW = struct.Struct(">H13s")
NO_ECHO = 2**64 - 1
ROWS_SIZE = 1000
"""Bytes of rows in one report, so that it is one packet whatever the mtu is."""
MISSING_ROWS = ROWS_SIZE // _MISSING_ROW.size
MOST_ASTRAY = 48
"""Runs in a ping, which then fits the smallest mtu."""
MOST_RUN = 2**16 - 1
"""Packets of such a run."""


class Feedback(NamedTuple):
    """What one end knows of a path by what arrived on it. Sums count since the session's keys were made."""

    capacity: float
    """Highest rate that the path may have, bits per second; inf if nothing says that it has a limit."""
    queue: float
    """Seconds that packets wait in a standing queue."""
    rate: float
    """Bits per second that arrived of late."""
    settled: int
    """Packets known to have been sent."""
    lost: int
    """Those of them that did not arrive."""
    runs: int
    """Runs of lost packets."""
    time: float
    """Seconds from the first to the last packet of each run, summed."""
    time_squared: float


class Ping(NamedTuple):
    """Keepalive, clock exchange, path probe, feedback. The time of sending is the message's own time of publishing."""

    path: int
    """What it is sent by."""
    cost: int
    """The sender's preference among paths; only the robot's end counts."""
    ask: bool
    """An answer is wanted at once, by the same path."""
    size: int
    """Size of the datagram that asks, or of the one that is answered, if that was padded; else 0."""
    echo: int | None
    """The peer's latest time stamp (microseconds of its clock); None if it sent none yet."""
    challenge: int
    """64 random bits that the answer repeats, of a question to an address that has to be proven; else 0."""
    hold: int
    """Microseconds since that arrived."""
    feedback: Feedback
    astray: tuple[tuple[int, int], ...] = ()
    """Packets of the path that went to other addresses of late, as runs: packet number of the first, and how many."""


class SenderRow(NamedTuple):
    """A topic's counters at its sender; names as in `stats.TopicStats`."""

    topic: int
    used: int
    """Sequence numbers used in this epoch."""
    offered: int
    sent: int
    expired: int
    replaced: int
    retransmitted: int
    bytes_sent: int


class ReceiverRow(NamedTuple):
    """A topic's counters at its receiver; names as in `stats.TopicStats`."""

    topic: int
    delivered: int
    lost: int
    late: int
    expired: int
    superseded: int
    duplicate: int
    bytes_delivered: int
    delay_p50: float
    delay_p99: float
    delay_max: float
    delay_error: float
    jitter: float
    jitter_in_order: float
    period_p50: float
    period_p99: float


class Report(NamedTuple):
    """What one end counted."""

    senders: tuple[SenderRow, ...]
    receivers: tuple[ReceiverRow, ...]


class Goodbye(NamedTuple):
    """The peer ends the session."""


class Ack(NamedTuple):
    """What the receiver of a reliable topic has."""

    topic: int
    expected: int
    """It has all below this sequence number, or knows that they will not come."""
    held: bytes
    """Bit i (from the lowest of the first byte) is set if it has number ``expected + 1 + i``."""


class Missing(NamedTuple):
    """What the receiver of a reliable topic lacks of one large message."""

    topic: int
    number: int
    """Of the message, as in its packets' header."""
    until: int
    """Nothing is said of this block and those after it; blocks before it that are not among the rows are complete."""
    rows: tuple[tuple[int, bytes], ...]
    """Blocks, and data shards missing in them: bit i (from the lowest of the first byte) is shard i."""


class Forward(NamedTuple):
    """The sender of a reliable topic will not send numbers below this one any more."""

    topic: int
    base: int


Frame = Ping | Report | Goodbye | Ack | Missing | Forward


PING_SIZE = _PING.size


def push_ping(ping: Ping, padding: int = 0) -> bytes:
    """Encode, with that many zeros more; sums wrap, and at most `MOST_ASTRAY` runs, the last, are told."""
    echo = NO_ECHO if ping.echo is None else min(max(ping.echo, 0), NO_ECHO - 1)  # a peer may claim any time
    hold, feedback = min(max(ping.hold, 0), 2**32 - 1), ping.feedback
    sums = (value & 0xFFFFFFFF for value in (feedback.settled, feedback.lost, feedback.runs))
    head = PING, ping.path, ping.cost, ping.ask, ping.size, echo, ping.challenge, hold
    fixed = _PING.pack(*head, *feedback[:3], *sums, *feedback[6:])
    if not ping.astray:
        return fixed + bytes(padding)  # which is as good as that there are none
    runs = ping.astray[-MOST_ASTRAY:]
    return fixed + bytes([len(runs)]) + b"".join(_ASTRAY.pack(*run) for run in runs) + bytes(padding)


def push_goodbye() -> bytes:
    """Encode."""
    return bytes([GOODBYE])


def push_ack(ack: Ack) -> bytes:
    """Encode."""
    return _ACK.pack(ACK, ack.topic, ack.expected) + ack.held


def push_missing(missing: Missing) -> bytes:
    """Encode; at most `MISSING_ROWS` rows."""
    head = _MISSING.pack(MISSING, missing.topic, missing.number, missing.until)
    return head + b"".join(_MISSING_ROW.pack(*row) for row in missing.rows)


def push_forward(forward: Forward) -> bytes:
    """Encode."""
    return _ACK.pack(FORWARD, forward.topic, forward.base)


def push_reports(senders: list[SenderRow], receivers: list[ReceiverRow]) -> Iterator[bytes]:
    """Encode as many messages of one packet as the rows need, at least one."""
    while True:
        count_s = min(len(senders), ROWS_SIZE // _SENDER.size)
        count_r = min(len(receivers), (ROWS_SIZE - count_s * _SENDER.size) // _RECEIVER.size)
        rows = [_SENDER.pack(*row) for row in senders[:count_s]] + [_RECEIVER.pack(*row) for row in receivers[:count_r]]
        yield _REPORT.pack(REPORT, count_s, count_r) + b"".join(rows)
        senders, receivers = senders[count_s:], receivers[count_r:]
        if not senders and not receivers:
            return


def _pull_astray(data: bytes) -> tuple[tuple[int, int], ...]:
    """What follows the fixed part of a ping: nothing, or zeros, from an end that has none, or of an earlier version."""
    count = data[_PING.size] if len(data) > _PING.size else 0
    if count > MOST_ASTRAY:
        return ()
    start = _PING.size + 1
    return tuple(_ASTRAY.unpack_from(data, start + i * _ASTRAY.size) for i in range(count))


def pull_frame(data: bytes) -> Frame | None:
    """Decode any of them; None if it is none. Longer messages of later versions are cut to what is known."""
    try:
        kind = data[0]
        if kind == PING:
            _, path, cost, ask, size, echo, challenge, hold, *fields = _PING.unpack_from(data)
            feedback = Feedback(*fields)
            known = feedback if feedback.capacity != math.inf else feedback[1:]
            if min(feedback) < 0 or not all(map(math.isfinite, known)):
                return None
            echo = None if echo == NO_ECHO else echo
            return Ping(path, cost, bool(ask), size, echo, challenge, hold, feedback, _pull_astray(data))
        if kind == REPORT:
            _, count_s, count_r = _REPORT.unpack_from(data)
            at = _REPORT.size
            end = at + count_s * _SENDER.size
            senders = tuple(SenderRow(*row) for row in _SENDER.iter_unpack(data[at:end]))
            receivers = tuple(
                ReceiverRow(*row) for row in _RECEIVER.iter_unpack(data[end : end + count_r * _RECEIVER.size])
            )
            return Report(senders, receivers)
        if kind == GOODBYE:
            return Goodbye()
        if kind == ACK:
            _, topic, expected = _ACK.unpack_from(data)
            return Ack(topic, expected, data[_ACK.size :])
        if kind == MISSING:
            _, topic, number, until = _MISSING.unpack_from(data)
            body = data[_MISSING.size :]
            return Missing(topic, number, until, tuple(_MISSING_ROW.iter_unpack(body)))
        if kind == FORWARD:
            _, topic, base = _ACK.unpack_from(data)
            return Forward(topic, base)
    except (IndexError, struct.error):
        pass
    return None
