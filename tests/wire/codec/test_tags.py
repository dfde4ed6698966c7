"""Tags of shards, against the definition in plain integers."""

import os

import numpy as np
import pytest
from cryptography.hazmat.primitives.ciphers import Cipher
from cryptography.hazmat.primitives.ciphers.algorithms import AES
from cryptography.hazmat.primitives.ciphers.modes import CTR, ECB
from deep_size import deep_size

from skytether.wire.codec.tags import SECRET_SIZE, Tags

SECRET = bytes(range(SECRET_SIZE))


def by_definition(packet, secret=SECRET):
    """Word by word: hash keys from AES-CTR, the block through AES."""
    count = len(packet) // 4
    stream = Cipher(AES(secret[:32]), CTR(bytes(16))).encryptor().update(bytes(16 * (count + 2)))
    keys = [int.from_bytes(stream[i : i + 8], "little") for i in range(0, len(stream), 8)]
    words = [int.from_bytes(packet[i : i + 4], "little") for i in range(0, len(packet), 4)]
    upper = []
    for turn in range(2):
        total = keys[turn] + count * keys[2 + turn]
        total += sum(word * keys[4 + 2 * i + turn] for i, word in enumerate(words) if not 6 <= i < 10)
        upper.append((total % 2**64 >> 32).to_bytes(4, "little"))
    block = packet[24:28] + upper[0] + packet[28:32] + upper[1]
    return Cipher(AES(secret[32:]), ECB()).encryptor().update(block)[:8]


@pytest.mark.parametrize("size", [44, 280, 1200, 1400, 9000, 65_504])
@pytest.mark.parametrize("count", [1, 2, 33])
def test_tags_are_as_defined_one_by_one_and_together(size, count):
    tags = Tags(SECRET)
    rows = np.frombuffer(bytearray(os.urandom(count * size)), np.uint8).reshape(count, size)
    tags.put(rows)
    packets = [row.tobytes() for row in rows]
    assert [p[32:40] for p in packets] == [by_definition(p) for p in packets]
    assert tags.check(rows).all()
    assert all(tags.check_one(p) for p in packets)
    rows[count // 2, size - 1] ^= 1
    assert (np.flatnonzero(~tags.check(rows)) == [count // 2]).all()
    assert not tags.check_one(rows[count // 2].tobytes())


def test_zeros_at_the_end_count():
    tags = Tags(SECRET)
    short = np.frombuffer(bytearray(1200), np.uint8).reshape(1, -1)
    tags.put(short)
    assert not tags.check_one(short.tobytes() + bytes(4))


def test_packets_larger_than_any_datagram_are_checked_too():
    tags = Tags(SECRET)
    rows = np.zeros((2, 200_000), np.uint8)
    assert not tags.check(rows).any()
    Tags(SECRET).put(rows)
    assert tags.check(rows).all()
    assert rows[1, 32:40].tobytes() == by_definition(rows[1].tobytes())


def test_packets_of_many_sizes_take_little_memory():
    tags = Tags(SECRET)
    taken = []
    for size in range(44, 8000, 4):
        assert not tags.check_one(bytes(size))
        taken.append(deep_size(tags))
    assert max(taken) < taken[0] + 300 * 500
