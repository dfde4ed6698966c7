"""What the keys of a handshake open, and what they do not."""

import pytest

from skytether.wire.codec import crypto
from skytether.wire.codec.ciphers import Ciphers

KEY = bytes(range(32))


def pair():
    """Keys of both ends."""
    return Ciphers(KEY, bytes(32), b"", 1), Ciphers(bytes(32), KEY, b"", 1)


def seal(ciphers, number, plaintext, common):
    out = bytearray(len(plaintext) + crypto.TAG_SIZE)
    ciphers.seal_into(number, plaintext, common, memoryview(out))
    return out


@pytest.mark.parametrize("spoil", ["number", "common", "text", "tag", "short"])
def test_nothing_but_the_message_itself_opens(spoil):
    one, other = pair()
    sealed = seal(one, 5, b"text", b"common")
    number, common = 5, b"common"
    assert other.open(number, sealed, common) == b"text"
    assert one.open(number, sealed, common) is None  # each direction has its own keys
    if spoil == "number":
        number = 6
    elif spoil == "common":
        common = b"Common"
    elif spoil == "text":
        sealed[0] ^= 1
    elif spoil == "tag":
        sealed[-1] ^= 1
    else:
        del sealed[3:]
    assert other.open(number, sealed, common) is None


def test_a_message_and_a_packet_of_the_same_number_are_sealed_with_different_keys():
    one, other = pair()
    header = bytes(31) + b"x"
    packet = one.seal_packet(header, b"text")
    assert other.open_packet(packet) == b"text"
    assert packet[32:] != seal(one, 0, b"text", header)
    assert other.open(0, packet[32:], header) is None


def test_keys_of_a_handshake_are_all_different(monkeypatch):
    made = []
    aead = crypto.Aead.__init__
    monkeypatch.setattr(crypto.Aead, "__init__", lambda self, key: (made.append(key), aead(self, key))[1])
    pair()
    assert len(made) == 8
    assert len(set(made)) == 4
