"""The two ends of a reliable topic, and a large message on its way, each alone."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skytether.wire.codec.frames import (
    MISSING_ROWS,
    Ack,
    Forward,
    Missing,
    pull_frame,
    push_ack,
    push_forward,
    push_missing,
)
from skytether.wire.codec.packet import SHARD_AT, pull_header, push_common
from skytether.wire.codec.plaintext import PREFIX
from skytether.wire.codec.tags import SECRET_SIZE, Tags
from skytether.wire.fec.fragment import shape_for
from skytether.wire.measure.counters import Outbound
from skytether.wire.measure.rtt import FIRST, LONGEST, RttEstimator
from skytether.wire.reliable.parcel import Parcel
from skytether.wire.reliable.reliable_sender import WINDOW, WINDOW_BYTES, Inbox, Outbox
from skytether.wire.topic import Direction, Topic

numbers = st.integers(0, 2**64 - 1)
indices = st.integers(0, 2**16 - 1)


@given(
    st.builds(Ack, indices, numbers, st.binary(max_size=128)),
    st.builds(
        Missing, indices, numbers, indices,
        st.lists(st.tuples(indices, st.binary(min_size=13, max_size=13)), max_size=MISSING_ROWS).map(tuple),
    ),
    st.builds(Forward, indices, numbers),
)  # fmt: skip
def test_frames_travel_in_a_packet(ack, missing, forward):
    assert pull_frame(push_ack(ack)) == ack
    assert pull_frame(push_missing(missing)) == missing
    assert pull_frame(push_forward(forward)) == forward
    assert len(push_missing(missing)) < 1024


def outbox(**options):
    topic = Topic("t", "a/b", Direction.IN, **{"lifespan": 10.0, "depth": 5000, "reliable": True, **options})
    box = Outbox(topic, Outbound(), RttEstimator())
    box.start_epoch(1, topic, box.counters, 0.0, newcomer=True)
    return box


def sent(box, now):
    """Everything that the box wants to send now."""
    out = []
    while box.ready:
        letter = box.next(now)
        box.sent(letter, now)
        out.append((letter.sequence, letter.sequence - PREFIX.unpack(box.prefix(letter))[1]))
    return out


def test_what_is_under_way_is_bounded_by_number_and_by_bytes():
    box = outbox()
    for _ in range(WINDOW + 10):
        assert box.put(b"x", 0.0, 1000)
    assert len(sent(box, 0.0)) == WINDOW
    box.acknowledged(Ack(1, 5, b""))
    assert sent(box, 0.0) == [(WINDOW + i, 5) for i in range(5)]
    box = outbox()
    for _ in range(3):
        assert box.put(bytes(WINDOW_BYTES), 0.0, 10 * WINDOW_BYTES)
    assert sent(box, 0.0) == [(0, 0)]
    box.acknowledged(Ack(1, 1, b""))
    assert sent(box, 0.0) == [(1, 1)]


def test_what_is_not_acknowledged_is_sent_again_later_and_later():
    box = outbox()
    for payload in (b"0", b"1", b"2"):
        box.put(payload, 0.0, 1000)
    assert sent(box, 0.0) == [(0, 0), (1, 0), (2, 0)]
    box.acknowledged(Ack(1, 0, b"\x02"))  # 2 is there, 0 and 1 are not
    times = []
    for _ in range(5):
        times.append(box.due)
        box.handle_timer(box.due - 1e-6)
        assert not box.ready
        box.handle_timer(box.due)
        assert sent(box, times[-1]) == [(0, 0), (1, 0)]
    waits = np.diff([0.0, *times])
    assert waits == pytest.approx([FIRST, 2 * FIRST, 4 * FIRST, LONGEST, LONGEST])
    assert box.counters.retransmitted == 10
    assert box.counters.sent == 3
    box.acknowledged(Ack(1, 3, b""))
    assert box.idle
    assert box.used == 0


def test_what_expires_is_forwarded_until_the_peer_knows():
    box = outbox(lifespan=1.0)
    box.put(b"0", 0.0, 1000)
    sent(box, 0.0)
    box.handle_timer(1.0)
    assert (box.base, box.counters.expired) == (1, 1)
    assert box.forwarding(1.0)
    assert not box.forwarding(1.0)
    assert box.forwarding(box.due)
    box.acknowledged(Ack(1, 1, b""))
    assert box.idle


def deliver(inbox, sequence, base, now=0.0):
    return [s for s, _, _ in inbox.take(PREFIX.pack(sequence, sequence - base) + b"%d" % sequence, 7, now)]


@given(st.permutations(range(12)), st.data())
def test_any_order_of_arrival_is_delivered_in_order_once(order, data):
    inbox = Inbox(set())
    got = deliver(inbox, 0, 0)
    for sequence in order:
        for _ in range(data.draw(st.integers(1, 2))):
            got += deliver(inbox, sequence, 0)
    assert got == list(range(12))
    assert inbox.acknowledgement() == Ack(0, 12, b"")


def test_gaps_are_told_and_what_is_given_up_is_skipped():
    inbox = Inbox(set())
    assert deliver(inbox, 3, 2) == []
    assert deliver(inbox, 12, 2) == []
    assert inbox.acknowledgement() == Ack(0, 2, b"\x01\x02")
    assert deliver(inbox, 5, 4) == [3]
    assert inbox.skipped == 1
    assert [s for s, _, _ in inbox.forward(10)] == [5]
    assert inbox.skipped == 1 + 5
    assert deliver(inbox, 4, 2) == []
    assert inbox.acknowledgement() == Ack(0, 10, b"\x02")


@given(st.lists(st.tuples(numbers, st.integers(0, 2**32 - 1), st.integers(0, 300_000)), max_size=30), numbers)
def test_whatever_an_authentic_peer_says_is_bounded(messages, base):
    inbox = Inbox(set())
    for sequence, below, size in messages:
        inbox.take(PREFIX.pack(sequence, below) + bytes(size), 0, 0.0)
        inbox.forward(base)
        assert inbox._held_bytes <= 2 * WINDOW_BYTES + size
        ack = inbox.acknowledgement()
        assert ack is None or len(push_ack(ack)) < 200
    inbox.take(b"short", 0, 0.0)


def parcel(shards=250, size=300):
    shape = shape_for(shards * size, size)
    sealed = memoryview(bytes(range(250)) * (shards * size // 250))
    common = push_common(16, 1, 2, 99, 3, shape.length)
    return Parcel(99, common, sealed, shape, Tags(bytes(SECRET_SIZE)), lambda parcel, now: None), shape, sealed


def take_all(parcel, now):
    out = []
    while parcel.remaining:
        count = min(parcel.remaining, 7)
        packets = parcel.take(count, 0, 0, 0)
        parcel.sent(count, now)
        size = parcel.packet_size
        out += [bytes(packets[i * size : (i + 1) * size]) for i in range(count)]
    return out


def test_a_parcel_sends_all_then_what_is_missing_and_only_once_a_round_trip():
    sending, _, sealed = parcel()
    first = take_all(sending, 0.0)
    assert b"".join(p[SHARD_AT:] for p in first) == bytes(sealed)
    rows = ((0, bytes([0b101] + [0] * 12)), (2, bytes([1] + [0] * 12)))
    assert sending.missing(3, rows, 0.05, 0.1) == 0  # they may still be on their way
    assert sending.missing(3, rows, 0.2, 0.1) == 3
    assert sending.missing(3, rows, 0.2, 0.1) == 0
    again = take_all(sending, 0.2)
    assert [pull_header(p)[6:8] for p in again] == [(0, 0), (0, 2), (2, 0)]
    assert all(p[SHARD_AT:] in bytes(sealed) for p in again)


def test_a_parcel_nobody_tells_about_is_probed_with_one_shard():
    sending, _, _ = parcel()
    take_all(sending, 0.0)
    assert sending.remind(1.0, 0.1) == 1
    assert len(take_all(sending, 1.0)) == 1
    sending.missing(1, ((0, bytes([0b11] + [0] * 12)),), 1.05, 0.1)
    assert sending.remaining == 2  # of the block that was told of, and of no other
    sending.cancel()
    assert sending.remaining == 0
