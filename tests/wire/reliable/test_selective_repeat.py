"""The shards of a large message on its way, alone."""

from skytether.wire.codec.packet import SHARD_AT, pull_header, push_common
from skytether.wire.codec.tags import SECRET_SIZE, Tags
from skytether.wire.fec.fragment import shape_for
from skytether.wire.reliable.selective_repeat import SelectiveRepeat


def large_message(shards=250, size=300):
    shape = shape_for(shards * size, size)
    sealed = memoryview(bytes(range(250)) * (shards * size // 250))
    common = push_common(16, 1, 2, 99, 3, shape.length)
    return SelectiveRepeat(99, common, sealed, shape, Tags(bytes(SECRET_SIZE)), lambda shards, now: None), shape, sealed


def take_all(sending, now):
    out = []
    while sending.remaining:
        count = min(sending.remaining, 7)
        packets = sending.make_packets(count, 0, 0, 0)
        sending.sent(count, now)
        size = sending.packet_size
        out += [bytes(packets[i * size : (i + 1) * size]) for i in range(count)]
    return out


def test_a_large_message_sends_all_then_what_is_missing_and_only_once_a_round_trip():
    sending, _, sealed = large_message()
    first = take_all(sending, 0.0)
    assert b"".join(p[SHARD_AT:] for p in first) == bytes(sealed)
    rows = ((0, bytes([0b101] + [0] * 12)), (2, bytes([1] + [0] * 12)))
    assert sending.missing(3, rows, 0.05, 0.1) == 0  # they may still be on their way
    assert sending.missing(3, rows, 0.2, 0.1) == 3
    assert sending.missing(3, rows, 0.2, 0.1) == 0
    again = take_all(sending, 0.2)
    assert [pull_header(p)[6:8] for p in again] == [(0, 0), (0, 2), (2, 0)]
    assert all(p[SHARD_AT:] in bytes(sealed) for p in again)


def test_a_large_message_nobody_tells_about_is_probed_with_one_shard():
    sending, _, _ = large_message()
    take_all(sending, 0.0)
    assert sending.remind(1.0, 0.1) == 1
    assert len(take_all(sending, 1.0)) == 1
    sending.missing(1, ((0, bytes([0b11] + [0] * 12)),), 1.05, 0.1)
    assert sending.remaining == 2  # of the block that was told of, and of no other
    sending.cancel()
    assert sending.remaining == 0
