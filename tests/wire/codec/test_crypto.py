"""Keys and ciphers."""

from skytether.wire.codec import crypto

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


def test_ids_of_packets_depend_on_the_handshake():
    ids = {crypto.packet_id(KEY, shared, hello) for shared in (b"a", b"b") for hello in (b"c", b"d")}
    assert len(ids) == 4
