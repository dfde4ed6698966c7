"""The header's codec."""

from hypothesis import given
from hypothesis import strategies as st

from skytether.wire import peek_id
from skytether.wire.codec import packet


@given(
    kind=st.integers(0, 255),
    session_id=st.integers(0, 2**64 - 1),
    epoch=st.integers(0, 255),
    number=st.integers(0, 2**48 - 1),
    topic=st.integers(0, 2**16 - 1),
    length=st.integers(0, 2**32 - 1),
    block=st.integers(0, 2**16 - 1),
    index=st.integers(0, 255),
    path=st.integers(0, 255),
    packet_number=st.integers(0, 2**32 - 1),
    time=st.integers(0, 2**16 - 1),
)
def test_round_trip(kind, session_id, epoch, number, topic, length, block, index, path, packet_number, time):
    common = packet.push_common(kind, session_id, epoch, number, topic, length)
    header = common + packet.push_shard(block, index, path, packet_number, time)
    assert packet.pull_header(header + b"shard") == (
        kind, session_id, epoch, number, topic, length, block, index, path, packet_number, time,
    )  # fmt: skip
    assert peek_id(memoryview(header)) == (kind % 16 == 1, session_id)
    # What `receiver` and `fragment` find by position.
    assert header[: packet.COMMON_SIZE] == common
    assert header[packet.INDEX_AT] == index
    assert header[packet.PATH_AT] == path
    assert int.from_bytes(header[packet.NUMBER_AT : packet.TIME_AT], "big") == packet_number
    assert int.from_bytes(header[packet.TIME_AT : packet.HEADER_SIZE], "big") == time
    assert int.from_bytes(header[packet.COMMON_SIZE : packet.INDEX_AT], "big") == block


def test_an_array_of_packets_has_the_same_fields():
    common = [packet.push_common(packet.SHARD, 2**64 - 1, 7, 2**40 + i, 9, 2400) for i in (1, 1, 2)]
    rows = [
        c + packet.push_shard(3, i, 4, 2**31 + i, 2**15 + i) + b"tag " * 2 + bytes((i,)) * 100
        for i, c in enumerate(common)
    ]
    packets = packet.pull_packets(b"".join(rows), 3, 140)
    assert packets["keys"][0].tobytes() == packet.KEYS.pack(packet.SHARD, 2**64 - 1, 7)
    assert [b.tobytes() for b in packets["block"]] == [row[: packet.BLOCK.size] for row in rows]
    assert packet.BLOCK.unpack(packets["block"][1].tobytes())[-1] == 3
    for name, first in (("index", 0), ("number", 2**31), ("time", 2**15)):
        assert packets[name].tolist() == [first, first + 1, first + 2]
    assert packets["path"].tolist() == [4, 4, 4]
    assert packets["shard"].tolist() == [[i] * 100 for i in range(3)]


def test_the_header_is_as_small_as_documented():
    assert (packet.COMMON_SIZE, packet.HEADER_SIZE, packet.SHARD_AT) == (22, 32, 40)


@given(st.binary(max_size=packet.HEADER_SIZE - 1))
def test_what_is_too_short_is_no_packet(data):
    assert packet.pull_header(data) is None
    assert peek_id(data) is None
