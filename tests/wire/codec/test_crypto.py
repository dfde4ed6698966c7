"""Keys and ciphers."""

import pytest

from skytether.wire.codec import crypto
from skytether.wire.codec.ciphers import Ciphers

KEY = bytes(range(32))


def test_both_ends_derive_the_same_keys_from_an_exchange():
    a, b = bytes([1]) * 32, bytes([2]) * 32
    shared = crypto.exchange(a, crypto.public_of(b))
    assert shared is not None
    assert shared == crypto.exchange(b, crypto.public_of(a))


def test_a_public_key_that_makes_the_secret_a_constant_is_refused():
    assert crypto.exchange(bytes([1]) * 32, bytes(32)) is None


def test_data_keys_depend_on_everything():
    parts = [KEY, b"s" * 32, b"hello", b"welcome"]
    seen = {crypto.data_keys(*parts)}
    for i in range(4):
        changed = [p if i != j else bytes([p[0] ^ 1]) + p[1:] for j, p in enumerate(parts)]
        seen.add(crypto.data_keys(*changed))
    assert len(seen) == 5
    up, down, name = seen.pop()
    assert len({up, down}) == 2
    assert (len(up), len(down), len(name)) == (32, 32, 8)


def test_hkdf_is_rfc_5869():
    # RFC 5869, appendix A.1, with our label in front of its info left out: derive() is HKDF-SHA256 of the label + info.
    import hashlib
    import hmac

    def oracle(secret, salt, info, length):
        prk = hmac.new(salt, secret, hashlib.sha256).digest()
        out, block = b"", b""
        for i in range(1, -(-length // 32) + 1):
            block = hmac.new(prk, block + info + bytes([i]), hashlib.sha256).digest()
            out += block
        return out[:length]

    assert crypto.derive(KEY, b"salt", b"info", 72) == oracle(KEY, b"salt", b"skytether 2 info", 72)


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


def test_ids_of_packets_depend_on_the_handshake():
    ids = {crypto.packet_id(KEY, shared, hello) for shared in (b"a", b"b") for hello in (b"c", b"d")}
    assert len(ids) == 4
