import pytest

from skytether.bridge.echo import LARGEST, SMALLEST, EchoClient, EchoServer, answer, read_answer

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
