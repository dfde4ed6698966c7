"""The receiving end of a reliable topic, alone."""

from deep_size import deep_size
from hypothesis import given
from hypothesis import strategies as st

from skytether.wire.codec.frames import Ack, push_ack
from skytether.wire.codec.plaintext import PREFIX
from skytether.wire.reliable.reliable_receiver import HELD_LIMIT, ReliableReceiver

numbers = st.integers(0, 2**64 - 1)
indices = st.integers(0, 2**16 - 1)


def deliver(receiver, sequence, base, now=0.0):
    return [
        s for s, _, _ in receiver.receive_message(PREFIX.pack(sequence, sequence - base) + b"%d" % sequence, 7, now)
    ]


@given(st.permutations(range(12)), st.data())
def test_any_order_of_arrival_is_delivered_in_order_once(order, data):
    receiver = ReliableReceiver(set())
    got = deliver(receiver, 0, 0)
    for sequence in order:
        for _ in range(data.draw(st.integers(1, 2))):
            got += deliver(receiver, sequence, 0)
    assert got == list(range(12))
    assert receiver.acknowledgement() == Ack(0, 12, b"")


def test_gaps_are_told_and_what_is_given_up_is_skipped():
    receiver = ReliableReceiver(set())
    assert deliver(receiver, 3, 2) == []
    assert deliver(receiver, 12, 2) == []
    assert receiver.acknowledgement() == Ack(0, 2, b"\x01\x02")
    assert deliver(receiver, 5, 4) == [3]
    assert receiver.skipped == 1
    assert [s for s, _, _ in receiver.forward(10)] == [5]
    assert receiver.skipped == 1 + 5
    assert deliver(receiver, 4, 2) == []
    assert receiver.acknowledgement() == Ack(0, 10, b"\x02")


def test_what_waits_for_a_gap_is_bounded():
    receiver = ReliableReceiver(set())
    for sequence in range(1, 60):
        receiver.receive_message(PREFIX.pack(sequence, sequence) + bytes(100_000), 0, 0.0)
        assert deep_size(receiver) <= HELD_LIMIT + 20_000
    assert deep_size(receiver) > HELD_LIMIT - 100_000


@given(st.lists(st.tuples(numbers, st.integers(0, 2**32 - 1), st.integers(0, 300_000)), max_size=30), numbers)
def test_whatever_an_authentic_peer_says_is_bounded(messages, base):
    receiver = ReliableReceiver(set())
    for sequence, below, size in messages:
        receiver.receive_message(PREFIX.pack(sequence, below) + bytes(size), 0, 0.0)
        receiver.forward(base)
        assert deep_size(receiver) <= HELD_LIMIT + size + 20_000
        ack = receiver.acknowledgement()
        assert ack is None or len(push_ack(ack)) < 200
    receiver.receive_message(b"short", 0, 0.0)
