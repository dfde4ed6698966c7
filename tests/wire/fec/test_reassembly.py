"""Incomplete messages: bounds, fairness, age."""

from random import Random

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from skytether.wire.codec import packet
from skytether.wire.codec.tags import SECRET_SIZE, Tags
from skytether.wire.fec.fragment import Shards, shape_for
from skytether.wire.fec.reassembly import Reassembly

ROOM = 1168
HEADER = packet.SHARD_AT


def packets_of(message, number=3, topic=4, parity=0):
    """Rows of one message, with headers."""
    shape = shape_for(len(message), ROOM)
    padded = memoryview(message.ljust(shape.shards * shape.size, b"\0"))
    common = packet.push_common(packet.SHARD, 1, 2, number, topic, len(message))
    shards = Shards(common, padded, shape, parity, Tags(bytes(SECRET_SIZE)))
    data = shards.make_packets(shards.remaining, 0, 0, 0)
    return shape, np.frombuffer(data, np.uint8).reshape(-1, shards.packet_size)


def claim(reassembly, shape, row, now=0.0, lifespan=1.0, topic=4):
    block = int.from_bytes(row[22:24].tobytes(), "big")
    return reassembly.entry(row[:22].tobytes(), shape.size, shape.length, topic, block, lifespan, now), block


def add(reassembly, shape, row, **options):
    entry, block = claim(reassembly, shape, row, **options)
    return reassembly.add(entry, block, int(row[24]), row[HEADER:].data)


class Expired(list):
    def __call__(self, topic):
        self.append(topic)


@given(st.integers(2, 300), st.integers(0, 5), st.integers(0, 2**32))
@settings(max_examples=50)
def test_batches_singles_and_repetitions_give_the_same_message(shards, parity, seed):
    random = Random(seed)
    message = random.randbytes(shards * ROOM - random.randrange(shards))
    shape, rows = packets_of(message, parity=parity)
    reassembly = Reassembly(64 * 2**20, Expired())
    whole, at = None, 0
    while whole is None and at < len(rows):
        start = max(0, at - random.randrange(3))
        end = min(len(rows), start + random.choice((1, 2, 5, 16, 50)))
        blocks = rows[start:end, 23] + 256 * rows[start:end, 22].astype(int)
        end = start + int(np.argmax(blocks != blocks[0])) if (blocks != blocks[0]).any() else end
        batch = rows[start:end]
        if random.random() < 0.2:
            batch = np.concatenate([batch, batch[::-1]])
        entry, block = claim(reassembly, shape, rows[start])
        if len(batch) > 2:
            whole = reassembly.add_all(entry, block, batch[:, packet.INDEX_AT].copy(), batch[:, HEADER:].copy())
        else:
            for row in batch:
                whole = whole or reassembly.add(entry, block, int(row[24]), row[HEADER:].data)
        at = max(at, end)
    assert whole == message
    assert reassembly.used == len(reassembly) == 0


def test_shards_that_disagree_in_anything_do_not_mix():
    message = bytes(3 * ROOM)
    shape, rows = packets_of(message)
    reassembly = Reassembly(2**20, Expired())
    other_shape, other = packets_of(bytes(3 * ROOM - 1))  # the same number, another length
    for i in range(2):
        assert add(reassembly, shape, rows[i]) is None
        assert add(reassembly, other_shape, other[i]) is None
    assert len(reassembly) == 2
    assert add(reassembly, shape, rows[2]) == message
    assert len(reassembly) == 1


def test_a_shard_that_claims_much_reserves_nothing():
    reassembly = Reassembly(32 * 2**20, Expired())
    shape, rows = packets_of(bytes(16 * 2**20))
    add(reassembly, shape, rows[0])
    assert reassembly.used < 5000


def test_impossible_shards_are_refused():
    reassembly = Reassembly(2**20, Expired())
    for size, length, block in (
        (100, 0, 0),
        (100, 100, 0),
        (0, 50, 0),
        (50, 10_000, 0),
        (1002, 2001, 0),
        (700, 1400, 1),
    ):
        assert reassembly.entry(b"x", size, length, 4, block, 1.0, 0.0) is None
    assert reassembly.used == len(reassembly) == 0


def test_what_stays_incomplete_is_dropped_at_its_age():
    expired = Expired()
    reassembly = Reassembly(2**20, expired)
    shape, rows = packets_of(bytes(3 * ROOM))
    add(reassembly, shape, rows[0], now=0.0)
    add(reassembly, shape, rows[1], now=0.9)
    reassembly.expire_all(0.99)
    assert not expired
    assert add(reassembly, shape, rows[2], now=1.01) is None  # began anew
    assert expired == [4]
    reassembly.expire_all(9.0)
    assert expired == [4, 4]
    assert reassembly.used == 0


@given(st.integers(0, 2**32))
@settings(max_examples=6)
def test_a_flood_never_exceeds_the_bound(seed):
    random = Random(seed)
    limit = 100_000
    reassembly = Reassembly(limit, Expired())
    for i in range(1500):
        length = random.choice((2500, 50_000, 16 * 2**20))
        shape = shape_for(length, ROOM)
        common = packet.push_common(packet.SHARD, 1, 2, random.randrange(50), random.randrange(5), length)
        block = random.randrange(shape.blocks)
        entry = reassembly.entry(common, shape.size, length, random.randrange(5), block, 1.0, i * 1e-3)
        if random.random() < 0.5:
            reassembly.add(entry, block, random.randrange(256), memoryview(bytes(shape.size)))
        else:
            shards = np.zeros((random.randint(3, 20), shape.size), np.uint8)
            indices = (random.randrange(200) + np.arange(len(shards))).astype(np.uint8)
            reassembly.add_all(entry, block, indices, shards)
        assert 0 <= reassembly.used <= limit
    assert reassembly.evicted


def test_a_flood_of_one_topic_leaves_the_others_alone():
    reassembly = Reassembly(200_000, Expired())
    message = Random(1).randbytes(20 * ROOM)
    shape, rows = packets_of(message, topic=1)
    for i, row in enumerate(rows):
        for j in range(100):  # 100 forged shards for every real one
            length = 2 * ROOM
            common = packet.push_common(packet.SHARD, 1, 2, 100 * i + j, 2, length)
            entry = reassembly.entry(common, ROOM, length, 2, 0, 1.0, 0.0)
            reassembly.add(entry, 0, 0, memoryview(bytes(ROOM)))
        whole = add(reassembly, shape, row, topic=1)
    assert whole == message
    assert reassembly.evicted > 1500


def test_a_flood_of_a_messages_own_topic_drops_the_oldest_first():
    reassembly = Reassembly(200_000, Expired())
    for number in range(60):
        shape, rows = packets_of(bytes(10 * ROOM), number=number)
        add(reassembly, shape, rows[0])
    message = Random(2).randbytes(10 * ROOM)
    shape, rows = packets_of(message, number=99)
    for i, row in enumerate(rows):
        whole = add(reassembly, shape, row)
        forged_shape, forged = packets_of(bytes(10 * ROOM - 1), number=1000 + i)
        add(reassembly, forged_shape, forged[0])
    assert whole == message


def test_false_shards_of_the_same_message_are_forgotten_with_it():
    reassembly = Reassembly(2**20, Expired())
    message = Random(3).randbytes(3 * ROOM)
    shape, rows = packets_of(message)
    forged = rows.copy()
    forged[:, HEADER:] = 0
    assert add(reassembly, shape, forged[1]) is None
    assert add(reassembly, shape, rows[0]) is None
    assert add(reassembly, shape, rows[2]) != message  # spoilt: will not open
    for i in (1, 0):  # but the true shards that come again are taken
        assert add(reassembly, shape, rows[i]) is None
    assert add(reassembly, shape, rows[2]) == message
