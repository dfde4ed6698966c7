import asyncio

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skytether.ros.ros1.tcpros import (
    HeaderError,
    pack_answer,
    pack_frame,
    pack_header,
    read_frame,
    read_header,
    sums_differ,
    unpack_header,
)


def feed(data, call):
    async def run():
        reader = asyncio.StreamReader()
        reader.feed_data(data)
        reader.feed_eof()
        return await call(reader)

    return asyncio.run(run())


def test_a_header_is_laid_out_as_the_protocol_has_it():
    # wiki.ros.org/ROS/TCPROS: length of all, then length and name=value of each.
    assert pack_header({"topic": "/a", "x": ""}) == b"\x12\0\0\0\x08\0\0\0topic=/a\x02\0\0\0x="


@settings(max_examples=20)
@given(
    st.dictionaries(st.text(st.characters(exclude_characters="=", exclude_categories=["Cs"])), st.text(), max_size=8)
)
def test_what_is_packed_is_read(fields):
    assert feed(pack_header(fields), read_header) == fields


@given(st.binary(max_size=200))
def test_any_bytes_are_a_header_or_refused(data):
    try:
        fields = unpack_header(data)
    except HeaderError:
        return
    assert all(isinstance(text, str) for item in fields.items() for text in item)


@pytest.mark.parametrize("body", [b"\x01", b"\x05\0\0\0ab", b"\x02\0\0\0ab"])
def test_a_broken_header_is_refused(body):
    with pytest.raises(HeaderError):
        unpack_header(body)


def test_a_header_that_is_too_long_is_refused_before_it_is_read():
    with pytest.raises(HeaderError, match="4294967295 bytes"):
        feed(b"\xff\xff\xff\xff", read_header)


def test_frames_come_one_after_the_other_and_too_large_ones_are_passed_over():
    async def three(reader):
        return [await read_frame(reader, limit=100) for _ in range(3)]

    data = pack_frame(b"one") + pack_frame(bytes(200_000)) + pack_frame(b"")
    assert feed(data, three) == [b"one", 200_000, b""]
    with pytest.raises(EOFError):
        feed(b"\x05\0\0\0abc", read_frame)


def test_answers_of_services():
    assert pack_answer(b"yes") == b"\x01\x03\0\0\0yes"
    assert pack_answer("no") == b"\x00\x02\0\0\0no"


def test_only_two_known_sums_differ():
    assert sums_differ("a", "b")
    assert not any(sums_differ(*pair) for pair in (("a", "a"), ("*", "b"), ("a", ""), ("", "*")))
