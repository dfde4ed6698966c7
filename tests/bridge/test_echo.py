import socket

import pytest
from deep_size import deep_size

from skytether.bridge.echo import (
    ADDRESS_BURST,
    ADDRESS_RATE,
    ADDRESSES,
    LARGEST,
    RATE,
    SMALLEST,
    Allowance,
    EchoClient,
    EchoServer,
    answer,
    read_answer,
    was_answered,
)

NONCE = b"12345678"


def question(size: int = SMALLEST) -> bytes:
    return (b"SKYECHO?" + NONCE).ljust(size, b"\0")


@pytest.mark.parametrize("host", ["10.1.2.3", "2001:db8::1"])
@pytest.mark.parametrize("size", [SMALLEST, 1472, LARGEST])
def test_the_answer_tells_how_the_asker_is_seen_and_is_as_long_as_the_question(host, size):
    said = answer(question(size), (host, 4242))
    assert len(said) == size
    assert read_answer(said, NONCE) == (host, 4242)
    assert read_answer(said, b"87654321") is None


@pytest.mark.parametrize("data", [b"", b"SKYECHO?", question(SMALLEST - 1), question(LARGEST + 1), b"x" * 100])
def test_what_is_no_question_gets_no_answer(data):
    assert answer(data, ("10.1.2.3", 4242)) is None
    assert read_answer(data, NONCE) is None


def test_a_round_trip_over_sockets():
    with EchoServer("127.0.0.1", 0) as server, EchoClient(*server.address) as client:
        found = client.ask(10.0, 1200)
        assert found.seen_as[0] == "127.0.0.1"
        assert 0 < found.rtt < 10


def test_nobody_there_is_no_answer():
    with EchoServer("127.0.0.1", 0) as server:
        address = server.address
    with EchoClient(*address) as client:
        assert client.ask(0.2) is None


def said(allowance, size, host, now):
    """Bytes that an address gets for one question."""
    return size if allowance.admit(answer(question(size), (host, 4242)), now) else 0


@pytest.mark.parametrize("hosts", [["10.1.2.3"], [f"2001:db8::{i:x}" for i in range(1, 100)]])
def test_whoever_is_named_by_a_stranger_gets_a_trickle_of_answers(hosts):
    """Ten seconds of 9,000 bytes each millisecond: 90 MB of questions in somebody's name."""
    allowance = Allowance(0.0)
    got = sum(said(allowance, LARGEST, hosts[i % len(hosts)], i / 1000) for i in range(10_000))
    assert got <= ADDRESS_BURST + 10 * ADDRESS_RATE + LARGEST
    assert said(allowance, SMALLEST, "10.1.2.4", 10.0)  # others are answered


def test_invented_addresses_get_no_more_than_the_whole_and_no_memory():
    allowance = Allowance(0.0)
    got = sum(said(allowance, LARGEST, f"10.{i >> 16}.{i >> 8 & 255}.{i & 255}", i / 20_000) for i in range(20_000))
    assert got <= 2 * RATE + LARGEST
    full = deep_size(allowance)
    for i in range(ADDRESSES):
        said(allowance, SMALLEST, f"10.200.{i >> 8 & 255}.{i & 255}", 1.0)
    assert deep_size(allowance) <= full


def test_a_doctor_is_answered_all_that_it_asks():
    allowance = Allowance(0.0)
    assert all(said(allowance, SMALLEST, "10.1.2.3", i / 50) for i in range(200))
    assert all(said(allowance, size, "10.1.2.3", 4.0 + i / 10) for i, size in enumerate((1200, 1472, LARGEST) * 5))


def test_a_flooded_echo_counts_what_it_does_not_answer():
    with EchoServer("127.0.0.1", 0) as server, EchoClient(*server.address) as client:
        for _ in range(100):
            client.ask(0.02, LARGEST)
            if server.refused:
                break
        assert server.refused


def test_questions_in_a_robots_name_use_up_nothing_of_what_it_has():
    with EchoServer("127.0.0.1", 0) as server, EchoClient(*server.address) as client:
        assert client.ask(10.0) is not None
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            stranger.connect(server.address)
            while not server.refused:  # of this address, where others ask, too
                stranger.send(question(LARGEST))
            for number in range(20):
                stranger.send(question(LARGEST))
                assert client.ask(10.0, 1200) is not None, f"question {number} is not answered"
        assert client.ask(10.0) is not None


def test_a_cookie_is_good_for_the_address_that_got_it():
    mine = answer(question(), ("10.1.2.3", 4242), b"key")
    asked = question()[:16] + mine[34:42] + question()[24:]
    assert was_answered(asked, mine)
    assert not was_answered(asked, answer(asked, ("10.1.2.4", 4242), b"key"))
    assert not was_answered(asked, answer(asked, ("10.1.2.3", 4242), b"another"))
    assert not was_answered(question(), mine)
