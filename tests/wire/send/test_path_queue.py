"""What goes out on one path: batches, and messages that another path has as well."""

from hypothesis import given
from hypothesis import strategies as st

from skytether.wire import Config, Direction, Topic
from skytether.wire.codec.ciphers import Ciphers
from skytether.wire.measure.counters import Outbound
from skytether.wire.path.path import Path
from skytether.wire.send.message import Message
from skytether.wire.send.path_queue import MAX_IN_FLIGHT, MAX_SEGMENTS, MAX_URGENT, Batches, Copy, InFlight, PathQueue
from skytether.wire.state.epoch import SendTopic

CIPHERS = Ciphers(bytes(32), bytes(range(32)), bytes(8), 1)


@given(st.lists(st.integers(1, 4).map(lambda size: bytes(100 * size)), max_size=200))
def test_batches_keep_the_order_and_are_of_one_size_but_for_the_last_packet(packets):
    batches = Batches(3, "there")
    for packet in packets:
        batches.add(packet)
    batches.flush()
    assert b"".join(b.data for b in batches.done) == b"".join(packets)
    cut = []
    for batch in batches.done:
        assert (batch.path, batch.address) == (3, "there")
        step = batch.segment or len(batch.data)
        parts = [batch.data[i : i + step] for i in range(0, len(batch.data), step)]
        assert len(parts) <= MAX_SEGMENTS
        cut += parts
    assert [len(part) for part in cut] == [len(packet) for packet in packets]


def queue():
    return PathQueue(Path(0, Config(), 0.0), 1_000_000)


def topic(priority):
    return SendTopic(1, Topic("t", "a/b", Direction.IN, priority=priority, lifespan=10.0), Outbound())


def in_flight(priority, number=0, deadline=10.0):
    message = Message(CIPHERS, 1, number, 1, bytes(10_000))
    return InFlight(topic(priority), message.shards(1000), deadline)


def test_large_messages_of_another_path_are_sent_highest_priority_first_and_bounded():
    path_queue = queue()
    for i in range(MAX_IN_FLIGHT + 10):
        path_queue.enqueue(in_flight(i % 100, i), 0.0)
    priorities = [message.topic.priority for message in path_queue.in_flight]
    assert priorities == sorted(priorities)
    assert len(priorities) == MAX_IN_FLIGHT
    assert priorities[-1] == MAX_IN_FLIGHT + 10 - 1
    assert min(priorities) == 10


def test_what_may_not_have_arrived_is_repeated_and_what_is_too_old_is_not():
    first, other = queue(), queue()
    for sent_at, deadline in ((0.1, 10.0), (0.5, 10.0), (0.6, 0.7)):
        message = Message(CIPHERS, 1, 1, 1, b"x")
        first.remember(Copy(topic(5), message, 0, 0.0, 0.0, deadline), sent_at)
    first.repeat(other, 0.4, 1.0)
    assert len(other.queue) == 1
    first.repeat(other, 0.0, 1.0)  # nothing is repeated twice
    assert len(other.queue) == 1


def test_packets_that_wait_for_nothing_are_bounded_and_wake_at_once():
    path_queue = queue()
    assert path_queue.next_timer() == float("inf")
    for _ in range(MAX_URGENT + 5):
        path_queue.add_urgent(b"ping")
    assert path_queue.next_timer() == 0.0
    assert len(path_queue.urgent) == MAX_URGENT
    path_queue.clear()
    assert path_queue.next_timer() == float("inf")
