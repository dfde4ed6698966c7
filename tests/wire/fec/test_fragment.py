"""Shards of a message, against reassembly."""

from random import Random

from hypothesis import given
from hypothesis import strategies as st

from skytether.wire.codec import packet
from skytether.wire.codec.tags import SECRET_SIZE, Tags
from skytether.wire.fec.fragment import BLOCK_SHARDS, Shape, Shards, shape_for
from skytether.wire.fec.reassembly import Reassembly

ROOM = 1168
COMMON = packet.push_common(packet.DATA, 1, 2, 3, 4, 5)


@given(st.integers(ROOM + 1, 20 * 2**20), st.integers(482, 9000))
def test_a_shape_holds_the_message_with_the_fewest_equal_shards(length, room):
    shape = shape_for(length, room)
    if shape.shards == 1:
        return
    assert shape.valid
    assert shape.size <= room
    assert shape.size % 4 == 0
    assert shape.shards <= -(-length // (room // 4 * 4))
    assert 0 <= shape.shards * shape.size - length < max(shape.size, 4 * shape.shards)
    sizes = [shape.block_k(b) for b in range(shape.blocks)]
    assert sum(sizes) == shape.shards
    assert max(sizes) <= BLOCK_SHARDS
    assert max(sizes) - min(sizes) <= 1
    assert [shape.block_start(b) for b in range(shape.blocks)] == [sum(sizes[:b]) for b in range(shape.blocks)]


@given(st.integers(1, 2**32), st.integers(1, 65_507))
def test_any_claim_is_judged(length, size):
    shape = Shape(length, size)
    if shape.valid:
        assert shape.size % 4 == 0
        assert (shape.shards - 1) * shape.size < length <= shape.shards * shape.size


def cut(message, room, parity):
    shape = shape_for(len(message), room)
    padded = memoryview(message.ljust(shape.shards * shape.size, b"\0"))
    tags = Tags(bytes(SECRET_SIZE))
    return shape, Shards(packet.push_common(packet.SHARD, 1, 2, 3, 4, len(message)), padded, shape, parity, tags)


@given(st.integers(ROOM + 1, 400_000), st.integers(0, 12), st.integers(0, 2**32))
def test_any_loss_up_to_the_parity_is_made_good_in_any_order(length, parity, seed):
    random = Random(seed)
    message = random.randbytes(length)
    shape, shards = cut(message, ROOM, parity)
    total, number, packets = shards.remaining, 7, []
    assert total == shape.shards + parity * shape.blocks
    while shards.remaining:
        count = random.randint(1, min(64, shards.remaining))
        data = shards.make_packets(count, 0, number, 54_321)
        assert len(data) == count * shards.packet_size
        packets += [data[i : i + shards.packet_size] for i in range(0, len(data), shards.packet_size)]
        number += count
    headers = [packet.pull_header(p) for p in packets]
    assert [h[9] for h in headers] == list(range(7, 7 + total))
    assert {h[10] for h in headers} == {54_321}
    assert len({h[6:8] for h in headers}) == total
    lost = set()
    for block in range(shape.blocks):
        mine = [i for i, h in enumerate(headers) if h[6] == block]
        lost.update(random.sample(mine, parity))
    arriving = [p for i, p in enumerate(packets) if i not in lost]
    random.shuffle(arriving)
    reassembly = Reassembly(64 * 2**20, lambda topic: None)
    whole = None
    for i, p in enumerate(arriving):
        h = packet.pull_header(p)
        assert whole is None
        entry = reassembly.entry(bytes(p[:22]), shape.size, length, 4, h[6], 1.0, 0.0)
        whole = reassembly.add(entry, h[6], h[7], p[packet.SHARD_AT :])
        assert whole is None or i == len(arriving) - 1 or parity
        if whole is not None:
            break
    assert whole == message
    assert reassembly.used == 0


def test_parity_goes_last_and_in_turn_over_the_blocks():
    shape, shards = cut(bytes(250 * ROOM), ROOM, 3)
    data = shards.make_packets(shards.remaining, 0, 0, 0)
    headers = [packet.pull_header(data[i : i + shards.packet_size]) for i in range(0, len(data), shards.packet_size)]
    order = [(h[6], h[7]) for h in headers]
    assert shape.blocks == 3
    assert order[:250] == [(b, i) for b in range(3) for i in range(shape.block_k(b))]
    assert order[250:] == [(b, shape.block_k(b) + j) for j in range(3) for b in range(3)]
