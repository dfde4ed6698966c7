"""From authentic messages of topics to events."""

import math
from collections import Counter, deque

import pytest

from skytether.wire import Direction, Role, Topic
from skytether.wire.codec.ciphers import Ciphers
from skytether.wire.codec.compression import FLAG, compress
from skytether.wire.codec.frames import Forward
from skytether.wire.codec.plaintext import INNER, PREFIX
from skytether.wire.receive.delivery import COPY_BELOW, Delivery
from skytether.wire.reliable.reliable_receiver import ReliableReceiver
from skytether.wire.state.epoch import Epoch
from skytether.wire.state.topic_counters import TopicCounters

CIPHERS = Ciphers(bytes(32), bytes(32), bytes(8), 1)
SCAN = Topic("scan", "a/msg/B", Direction.IN, lifespan=0.2)
STATUS = Topic("status", "a/msg/B", Direction.IN, depth=10, reliable=True)
IMAGE = Topic("image", "a/msg/B", Direction.IN, depth=4)
TABLE = (SCAN, STATUS, IMAGE)


class End:
    """The service's end, under one handshake's keys."""

    def __init__(self, limit=1 << 20):
        self.events, self.rejected = deque(), Counter()
        self.delivery = Delivery(limit, self.events, self.rejected)
        self.counters = TopicCounters(Role.SERVICE)
        self.epoch = self.make_epoch()
        self.delivery.start_epoch(self.epoch)

    def make_epoch(self):
        send, receive = self.counters.topics(enumerate(TABLE, 1))
        return Epoch(1, CIPHERS, TABLE, send, receive, b"robot")

    def topic(self, topic, epoch=None):
        return next(t for t in (epoch or self.epoch).receive.values() if t.name == topic.name)

    def take(self, topic, payload, sequence=0, stamp=1_000_000, now=2.0, epoch=None):
        epoch = epoch or self.epoch
        plaintext = INNER.pack(sequence, stamp) + payload
        self.delivery.deliver_message(epoch, self.topic(topic, epoch), plaintext, sequence, stamp, now)

    @property
    def payloads(self):
        return [bytes(event.payload) for event in self.events]


@pytest.fixture
def end():
    return End()


def test_while_the_peers_clock_is_unknown_a_message_was_sent_when_it_came(end):
    end.take(SCAN, b"x", sequence=7)
    (event,) = end.events
    assert (event.topic, event.payload, event.sequence) == ("scan", b"x", 7)
    assert (event.sent_at, event.sent_at_error, event.received_at) == (2.0, math.inf, 2.0)
    assert math.isnan(end.topic(SCAN).counters.delay_error)


def test_once_it_is_known_the_time_of_publishing_is_in_this_ends_seconds(end):
    end.delivery.clock.exchange(1.0, 101.01, 101.01, 1.02)
    end.take(SCAN, b"x", stamp=101_500_000, now=1.53)
    (event,) = end.events
    assert event.sent_at == pytest.approx(1.5, abs=0.011)
    assert abs(event.sent_at - 1.5) <= event.sent_at_error <= 0.011


def test_another_peer_has_another_clock_and_new_keys_of_the_same_have_not(end):
    end.delivery.clock.exchange(1.0, 101.01, 101.01, 1.02)
    same = end.make_epoch()
    assert same.take_over(end.epoch)
    end.delivery.change_keys(same)
    end.take(SCAN, b"x", stamp=101_500_000, now=1.53, epoch=same)
    other = end.make_epoch()
    end.delivery.start_epoch(other)
    end.take(SCAN, b"y", stamp=101_500_000, now=1.53, epoch=other)
    assert [math.isfinite(event.sent_at_error) for event in end.events] == [True, False]


def test_small_payloads_are_bytes_and_large_ones_views_that_save_the_copy(end):
    end.take(IMAGE, bytes(COPY_BELOW))
    end.take(IMAGE, bytes(COPY_BELOW + 1), sequence=1)
    small, large = end.events
    assert type(small.payload) is bytes
    assert isinstance(large.payload, memoryview)
    assert large.payload.readonly
    assert len(large.payload) == COPY_BELOW + 1


def test_of_a_newest_value_topic_an_older_one_is_superseded_and_of_others_it_is_not(end):
    for topic in (SCAN, IMAGE):
        for sequence in (1, 0):
            end.take(topic, bytes([sequence]), sequence=sequence)
    assert [(event.topic, event.sequence) for event in end.events] == [("scan", 1), ("image", 1), ("image", 0)]
    counters = end.topic(SCAN).counters
    assert (counters.delivered, counters.superseded) == (1, 1)


def test_what_comes_under_old_keys_after_a_newer_one_is_superseded(end):
    before = end.epoch
    end.epoch = end.make_epoch()
    end.delivery.start_epoch(end.epoch)
    end.take(SCAN, b"old, and first", sequence=5, epoch=before)
    end.take(SCAN, b"new")
    end.take(SCAN, b"old", sequence=6, epoch=before)
    assert end.payloads == [b"old, and first", b"new"]


def test_a_compressed_payload_is_kept_small_until_it_is_taken(end):
    whole = bytes(100_000)
    packed = compress(whole)
    end.take(IMAGE, packed, stamp=1_000_000 | FLAG)
    (event,) = end.events
    assert len(event.payload) == len(packed)
    assert end.topic(IMAGE).counters.bytes_delivered == len(whole)
    assert end.delivery.unpack(event).payload == whole
    end.take(IMAGE, b"plain", sequence=1)
    assert end.delivery.unpack(end.events[1]) is end.events[1]


def test_what_would_grow_beyond_the_largest_message_is_refused():
    end = End(limit=1000)
    end.take(IMAGE, compress(bytes(1001)), stamp=FLAG)
    end.take(IMAGE, b"no zstd at all", sequence=1, stamp=FLAG)
    assert list(end.events) == []
    assert end.rejected == {"compressed": 2}


def test_what_says_to_grow_and_does_not_is_found_out_when_it_is_taken(end):
    end.take(IMAGE, compress(bytes(range(256)) * 100)[:-3], stamp=FLAG)
    (event,) = end.events
    assert end.delivery.unpack(event) is None
    assert end.rejected == {"compressed": 1}


def reliable(sequence, payload):
    """Of a sender that has given up nothing."""
    return PREFIX.pack(sequence, sequence) + payload


def test_messages_of_a_reliable_topic_are_handed_over_in_order(end):
    end.topic(STATUS).reliable_receiver = ReliableReceiver(set())
    end.take(STATUS, reliable(0, b"a"), stamp=1)
    end.take(STATUS, reliable(2, b"c"), stamp=3)
    assert end.payloads == [b"a"]
    end.take(STATUS, reliable(1, b"b"), stamp=2)
    assert end.payloads == [b"a", b"b", b"c"]
    assert [event.sequence for event in end.events] == [0, 1, 2]


def test_what_the_sender_gave_up_is_not_waited_for(end):
    end.topic(STATUS).reliable_receiver = ReliableReceiver(set())
    end.take(STATUS, reliable(0, b"a"))
    end.take(STATUS, reliable(2, b"c"))
    end.delivery.forward(Forward(2, 2), end.epoch, 2.1)
    assert end.payloads == [b"a", b"c"]
    end.topic(STATUS).settle(3.0)
    assert end.topic(STATUS).counters.lost == 1
    for index in (1, 99):  # no reliable topic, and none at all
        end.delivery.forward(Forward(index, 5), end.epoch, 2.2)
    assert len(end.events) == 2


def test_a_reliable_message_of_a_peer_that_is_gone_is_refused(end):
    end.take(STATUS, reliable(0, b"a"))
    assert list(end.events) == []
    assert end.rejected == {"epoch": 1}


def test_messages_that_stayed_incomplete_are_counted_by_their_topic(end):
    end.delivery.expired(3)
    end.delivery.expired(99)
    assert end.topic(IMAGE).counters.expired == 1
    end.delivery.end_epoch()
    end.delivery.expired(3)
    assert end.topic(IMAGE).counters.expired == 1
