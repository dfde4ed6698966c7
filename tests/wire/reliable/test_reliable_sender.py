"""The sending end of a reliable topic, alone."""

import numpy as np
import pytest

from skytether.wire.codec.frames import (
    Ack,
)
from skytether.wire.codec.plaintext import PREFIX
from skytether.wire.measure.counters import Outbound
from skytether.wire.measure.rtt import FIRST, LONGEST, RttEstimator
from skytether.wire.reliable.reliable_receiver import WINDOW, WINDOW_BYTES
from skytether.wire.reliable.reliable_sender import ReliableSender
from skytether.wire.topic import Direction, Topic


def reliable_sender(**options):
    topic = Topic("t", "a/b", Direction.IN, **{"lifespan": 10.0, "depth": 5000, "reliable": True, **options})
    sender = ReliableSender(topic, Outbound(), RttEstimator())
    sender.start_epoch(1, topic, sender.counters, 0.0, newcomer=True)
    return sender


def sent(sender, now):
    """Everything that the sender wants to send now."""
    out = []
    while sender.ready:
        pending = sender.next(now)
        sender.sent(pending, now)
        out.append((pending.sequence, pending.sequence - PREFIX.unpack(sender.prefix(pending))[1]))
    return out


def test_what_is_under_way_is_bounded_by_number_and_by_bytes():
    sender = reliable_sender()
    for _ in range(WINDOW + 10):
        assert sender.put(b"x", 0.0, 1000)
    assert len(sent(sender, 0.0)) == WINDOW
    sender.acknowledged(Ack(1, 5, b""))
    assert sent(sender, 0.0) == [(WINDOW + i, 5) for i in range(5)]
    sender = reliable_sender()
    for _ in range(3):
        assert sender.put(bytes(WINDOW_BYTES), 0.0, 10 * WINDOW_BYTES)
    assert sent(sender, 0.0) == [(0, 0)]
    sender.acknowledged(Ack(1, 1, b""))
    assert sent(sender, 0.0) == [(1, 1)]


def test_what_is_not_acknowledged_is_sent_again_later_and_later():
    sender = reliable_sender()
    for payload in (b"0", b"1", b"2"):
        sender.put(payload, 0.0, 1000)
    assert sent(sender, 0.0) == [(0, 0), (1, 0), (2, 0)]
    sender.acknowledged(Ack(1, 0, b"\x02"))  # 2 is there, 0 and 1 are not
    times = []
    for _ in range(5):
        times.append(sender.due)
        sender.handle_timer(sender.due - 1e-6)
        assert not sender.ready
        sender.handle_timer(sender.due)
        assert sent(sender, times[-1]) == [(0, 0), (1, 0)]
    waits = np.diff([0.0, *times])
    assert waits == pytest.approx([FIRST, 2 * FIRST, 4 * FIRST, LONGEST, LONGEST])
    assert sender.counters.retransmitted == 10
    assert sender.counters.sent == 3
    sender.acknowledged(Ack(1, 3, b""))
    assert sender.idle
    assert sender.used == 0


def test_what_expires_is_forwarded_until_the_peer_knows():
    sender = reliable_sender(lifespan=1.0)
    sender.put(b"0", 0.0, 1000)
    sent(sender, 0.0)
    sender.handle_timer(1.0)
    assert (sender.base, sender.counters.expired) == (1, 1)
    assert sender.forwarding(1.0)
    assert not sender.forwarding(1.0)
    assert sender.forwarding(sender.due)
    sender.acknowledged(Ack(1, 1, b""))
    assert sender.idle
