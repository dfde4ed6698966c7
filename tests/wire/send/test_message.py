"""From a message to packets, and back with the keys of the other end."""

from random import Random

import pytest

from skytether.wire.codec import packet
from skytether.wire.codec.ciphers import Ciphers
from skytether.wire.fec.fragment import encode_sealed
from skytether.wire.fec.reassembly import Reassembly
from skytether.wire.send.message import LoneShard, Message

OURS, THEIRS = bytes(32), bytes(range(32))
SENDS = Ciphers(OURS, THEIRS, bytes(8), 0xABCDEF)
TAKES = Ciphers(THEIRS, OURS, bytes(8), 0xABCDEF)
ROOM = 1168


def message(size, number=77):
    return Message(SENDS, 3, number, 5, Random(size).randbytes(size))


@pytest.mark.parametrize("size", [0, 1, 1000])
def test_one_packet_is_opened_by_the_other_end_and_names_its_place(size):
    sent = message(size)
    data = sent.packet(2, 4_000_000_000, 60_000)
    assert len(data) == packet.HEADER_SIZE + sent.size
    assert TAKES.open_packet(data) == sent.plaintext
    kind, session, epoch, number, topic, length, block, index, path, packet_number, time = packet.pull_header(data)
    assert (kind, session, epoch, number, topic) == (packet.DATA, 0xABCDEF, 3, 77, 5)
    assert (length, block, index, path, packet_number, time) == (sent.size, 0, 0, 2, 4_000_000_000, 60_000)


def test_each_packet_of_a_message_is_sealed_anew():
    sent = message(100)
    first, second = sent.packet(0, 1, 0), sent.packet(0, 2, 0)
    assert first[packet.HEADER_SIZE :] != second[packet.HEADER_SIZE :]
    assert TAKES.open_packet(first) == TAKES.open_packet(second) == sent.plaintext
    assert SENDS.open_packet(first) is None, "an end takes nothing that it has sent itself"


def reassemble(packets):
    """The plaintext that the other end gets; None: nothing that it takes."""
    reassembly, whole = Reassembly(2**20, lambda topic: None), None
    for data in packets:
        assert TAKES.check_one(data)
        header = packet.pull_header(data)
        common, shard = bytes(data[: packet.COMMON_SIZE]), memoryview(data)[packet.SHARD_AT :]
        entry = reassembly.entry(common, len(shard), header[5], header[4], header[6], 1.0, 0.0)
        whole = reassembly.add(entry, header[6], header[7], shard)
    return None if whole is None else TAKES.open(header[3], whole, common)


def test_a_large_message_is_sealed_once_and_cut_into_shards():
    sent = message(50_000)
    shards = sent.shards(ROOM)
    count = shards.remaining
    data = bytes(shards.make_packets(count, 1, 10, 0))
    packets = [data[i : i + shards.packet_size] for i in range(0, len(data), shards.packet_size)]
    assert max(map(len, packets)) <= ROOM + packet.SHARD_AT
    assert [packet.pull_header(one)[9] for one in packets] == list(range(10, 10 + count))
    assert reassemble(packets) == sent.plaintext


def test_a_lone_shard_is_the_packet_that_all_of_them_would_have_had():
    sent = message(5000)
    common, sealed, shape = sent.seal(ROOM)
    for index in range(shape.shards):
        shard = bytes(sealed[index * shape.size : (index + 1) * shape.size])
        lone = LoneShard(common, index, shard, SENDS.tagger)
        shards = sent.shards(ROOM)
        assert lone.size == shape.size
        together = bytes(shards.make_packets(shape.shards, 4, 100, 9))
        assert lone.packet(4, 100 + index, 9) == together[index * shards.packet_size : (index + 1) * shards.packet_size]


def test_a_lone_shard_of_parity_makes_good_a_lost_one():
    sent = message(5000)
    common, sealed, shape = sent.seal(ROOM)
    data = [bytes(sealed[i : i + shape.size]) for i in range(0, len(sealed), shape.size)]
    (parity,) = encode_sealed(sealed, shape, range(shape.shards, shape.shards + 1))
    there = {**dict(enumerate(data[1:], 1)), shape.shards: bytes(parity)}
    packets = [LoneShard(common, row, shard, SENDS.tagger).packet(0, row, 0) for row, shard in there.items()]
    assert reassemble(packets[:-1]) is None
    assert reassemble(packets) == sent.plaintext
