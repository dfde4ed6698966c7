"""The code of parity shards, against a slow one and by hand."""

from itertools import combinations
from random import Random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skytether.wire.fec.reed_solomon import encode, recover


def multiply(a, b):
    """In GF(256) with the polynomial x^8 + x^4 + x^3 + x^2 + 1."""
    product = 0
    while b:
        product ^= a * (b & 1)
        a = a << 1 ^ (0x11D if a & 0x80 else 0)
        b >>= 1
    return product


def divide(a, b):
    return next(q for q in range(256) if multiply(b, q) == a)


def block(k, size, seed=1):
    return np.frombuffer(Random(seed).randbytes(k * size), np.uint8).reshape(k, size)


@pytest.mark.parametrize(("k", "row"), [(2, 2), (2, 3), (3, 200), (100, 100), (100, 255)])
def test_a_row_is_what_it_is_said_to_be(k, row):
    data = block(k, 4)
    expected = [0] * 4
    for i in range(k):
        weight = divide(k ^ i, row ^ i)
        expected = [e ^ multiply(weight, int(byte)) for e, byte in zip(expected, data[i], strict=True)]
    assert list(encode(data, [row])[0]) == expected


def test_the_first_row_is_a_plain_sum():
    data = block(7, 16)
    assert encode(data, [7]) == [np.bitwise_xor.reduce(data, axis=0).tobytes()]


def test_any_k_of_a_block_will_do():
    data = block(4, 8)
    shards = [*(row.tobytes() for row in data), *encode(data, (4, 5, 6))]
    for chosen in combinations(range(7), 4):
        damaged = data.copy()
        missing = [i for i in range(4) if i not in chosen]
        damaged[missing] = 0xAA
        recover(damaged, missing, {i: np.frombuffer(shards[i], np.uint8) for i in chosen if i >= 4})
        assert (damaged == data).all()


@given(st.integers(2, 100), st.data())
def test_what_is_lost_is_had_back_from_any_rows_in_any_order(k, draw):
    data = block(k, 12, seed=k)
    missing = sorted(draw.draw(st.sets(st.integers(0, k - 1), min_size=1, max_size=12)))
    rows = draw.draw(
        st.lists(st.integers(k, 255), min_size=len(missing), max_size=len(missing) + 2, unique=True), label="rows"
    )
    parity = {row: np.frombuffer(shard, np.uint8) for row, shard in zip(rows, encode(data, rows), strict=True)}
    damaged = data.copy()
    damaged[missing] = 0
    recover(damaged, missing, parity)
    assert (damaged == data).all()


def test_a_whole_block_is_had_back_from_parity_alone():
    data = block(100, 4)
    rows = range(156, 256)
    damaged = np.zeros_like(data)
    parity = zip(rows, encode(data, rows), strict=True)
    recover(damaged, range(100), {row: np.frombuffer(shard, np.uint8) for row, shard in parity})
    assert (damaged == data).all()
