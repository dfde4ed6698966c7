"""Compressed payloads: what shrinks, what does not, and what a peer may make this end allocate."""

from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skytether.wire.codec.compression import LEAST, Compressed, compress, decompress, original_size, unpacked_size


@given(st.binary(min_size=1, max_size=50), st.integers(1, 200))
def test_what_was_compressed_comes_back(part, times):
    payload = part * times
    packed = compress(payload)
    assert original_size(packed) == len(payload)
    if isinstance(packed, Compressed):
        assert len(packed) < len(payload)
        assert unpacked_size(packed, len(payload)) == len(payload)
        assert decompress(packed, len(payload)) == payload
    else:
        assert packed is payload


def test_what_does_not_shrink_travels_as_it_is():
    noise = Random(1).randbytes(10_000)
    assert compress(noise) is noise
    short = bytes(LEAST - 1)
    assert compress(short) is short
    assert isinstance(compress(bytes(LEAST)), Compressed)


def test_what_grows_beyond_the_limit_is_refused():
    packed = compress(bytes(100_000))
    assert unpacked_size(packed, 99_999) is None
    assert decompress(packed, 99_999) is None
    assert decompress(packed, 100_000) == bytes(100_000)


@pytest.mark.parametrize("cut", [0, 1, 5, -1])
def test_a_part_of_it_is_nothing(cut):
    assert decompress(compress(b"a" * 50 + b"b" * 5000)[:cut], 10_000) is None


@given(st.binary(max_size=300))
def test_any_bytes_are_read_or_refused(data):
    grown = decompress(data, 1000)
    assert grown is None or len(grown) <= 1000
    size = unpacked_size(data, 1000)
    assert size is None or size <= 1000
