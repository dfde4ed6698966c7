"""What stands before the payload of a sealed message."""

from skytether.wire.codec.ciphers import Ciphers
from skytether.wire.codec.compression import FLAG, Compressed, compress
from skytether.wire.codec.plaintext import INNER, OVERHEAD, PREFIX, push_inner
from skytether.wire.send.message import Message

CIPHERS = Ciphers(bytes(32), bytes(range(32)), bytes(8), 1)


def test_sequence_and_microseconds_stand_in_network_order():
    assert push_inner(0x01020304, 1.5, b"x") == bytes.fromhex("01020304 000000000016e360")
    assert INNER.unpack(push_inner(7, 12.000001, b"")) == (7, 12_000_001)


def test_a_sequence_has_32_bits_and_begins_anew():
    assert INNER.unpack(push_inner(2**32 - 1, 0.0, b""))[0] == 2**32 - 1
    assert INNER.unpack(push_inner(2**32 + 5, 0.0, b""))[0] == 5


def test_the_highest_bit_of_the_time_tells_a_compressed_payload():
    packed = compress(bytes(1000))
    assert isinstance(packed, Compressed)
    assert INNER.unpack(push_inner(1, 2.0, packed)) == (1, 2_000_000 | FLAG)
    assert INNER.unpack(push_inner(1, 2.0, bytes(1000))) == (1, 2_000_000)


def test_the_overhead_is_what_a_sealed_message_has_beyond_prefix_and_payload():
    for prefix in (b"", PREFIX.pack(1, 0)):
        plaintext = push_inner(0, 0.0, b"payload") + prefix + b"payload"
        message = Message(CIPHERS, 1, 1, 1, plaintext)
        assert message.size == OVERHEAD + len(prefix) + len(b"payload")
