"""The header's codec."""

from hypothesis import given
from hypothesis import strategies as st

from skytether.wire import packet, peek_session_id


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
    assert peek_session_id(memoryview(header)) == session_id
    # What `receiver` and `fragment` find by position.
    assert header[: packet.COMMON_SIZE] == common
    assert header[packet.INDEX_AT] == index
    assert header[packet.PATH_AT] == path
    assert int.from_bytes(header[packet.NUMBER_AT : packet.TIME_AT], "big") == packet_number
    assert int.from_bytes(header[packet.TIME_AT : packet.HEADER_SIZE], "big") == time
    assert int.from_bytes(header[packet.COMMON_SIZE : packet.BLOCK_END], "big") == block


def test_the_header_is_as_small_as_documented():
    assert (packet.COMMON_SIZE, packet.HEADER_SIZE) == (22, 32)


@given(st.binary(max_size=packet.HEADER_SIZE - 1))
def test_what_is_too_short_is_no_packet(data):
    assert packet.pull_header(data) is None
    assert peek_session_id(data) is None
