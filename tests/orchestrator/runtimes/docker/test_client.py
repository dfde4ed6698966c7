"""What an engine may answer that is broken, or somebody else's."""

from __future__ import annotations

import contextlib
import io
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import requests
import urllib3
from docker.errors import APIError

from skytether.orchestrator.runtimes.base import RuntimeFailure, SiteSilentError
from skytether.orchestrator.runtimes.docker import client as clients
from skytether.orchestrator.runtimes.docker.client import Client, document
from skytether.orchestrator.runtimes.docker.engine import Engine
from skytether.orchestrator.runtimes.docker.options import DockerOptions
from skytether.orchestrator.runtimes.docker.volumes import remove_left

CHUNKED = b"HTTP/1.1 200 OK\r\nContent-Type: application/json\r\nTransfer-Encoding: chunked\r\n\r\n"
Answer = Callable[[bytes], Iterator[bytes]]


@pytest.fixture
def engine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Client]]:
    """A client of an engine that answers each request with these pieces, and is silent then."""
    monkeypatch.setattr(clients, "MOST_BYTES", 1 << 20)
    opened: list[socket.socket] = []
    made: list[Client] = []
    monkeypatch.chdir(tmp_path)

    def make(answer: Answer, timeout_s: float = 10.0) -> Client:
        listener = socket.socket(socket.AF_UNIX)
        listener.bind("engine.sock")
        listener.listen()
        opened.append(listener)

        def serve() -> None:
            with contextlib.suppress(OSError):
                while True:
                    taken, _ = listener.accept()
                    opened.append(taken)
                    asked = taken.recv(65_536)
                    with contextlib.suppress(OSError):
                        for piece in answer(asked):
                            taken.sendall(piece)

        threading.Thread(target=serve, daemon=True).start()
        made.append(Client(f"unix://{tmp_path}/engine.sock", version="1.41", timeout=timeout_s))
        return made[-1]

    yield make
    for client in made:
        client.close()
    for one in opened:
        with contextlib.suppress(OSError):
            one.shutdown(socket.SHUT_RDWR)
        one.close()


def chunks(piece: bytes, pause_s: float = 0.0) -> Iterator[bytes]:
    for _ in range(10_000):
        yield b"%x\r\n%s\r\n" % (len(piece), piece)
        time.sleep(pause_s)


@pytest.mark.parametrize("status", [b"200 OK", b"500 No"])
def test_an_answer_that_never_ends_costs_no_memory(engine: Callable[..., Client], status: bytes) -> None:
    def answer(_: bytes) -> Iterator[bytes]:
        yield CHUNKED.replace(b"200 OK", status)
        yield from chunks(b" " * 65_536)

    with pytest.raises(requests.ConnectionError, match="an answer of more than 1 MiB"):
        engine(answer).info()


def test_of_what_is_to_be_small_no_more_is_read(engine: Callable[..., Client]) -> None:
    sent: list[bytes] = []

    def answer(asked: bytes) -> Iterator[bytes]:
        yield CHUNKED
        if b"small" in asked:
            yield b"5\r\nhello\r\n0\r\n\r\n"
            return
        for piece in chunks(b" " * 65_536):
            sent.append(piece)
            yield piece

    client = engine(answer)
    assert client.fetch(f"{client.base_url}/small", 5).content == b"hello"
    with pytest.raises(requests.ConnectionError, match=r"an answer of more than 0\.0625 MiB"):
        client.fetch(f"{client.base_url}/large", 65_536)
    assert len(sent) < 50, "the rest was not taken"


def test_what_is_to_be_small_takes_no_longer_than_its_call_may(engine: Callable[..., Client]) -> None:
    def answer(_: bytes) -> Iterator[bytes]:
        yield CHUNKED
        yield from chunks(b" ", 0.02)

    client = engine(answer, 0.2)
    with pytest.raises(requests.RequestException):
        client.fetch(f"{client.base_url}/slow", 1000)


def drops(drop: bytes, pause_s: float = 0.02) -> Iterator[bytes]:
    for _ in range(10_000):
        yield drop
        time.sleep(pause_s)


@pytest.mark.parametrize(
    ("head", "body"),
    [
        (CHUNKED, chunks(b" ", 0.02)),
        (b"HTTP/1.1 200 OK\r\nContent-Length: 60000\r\n\r\n", drops(b" ")),
        (b"HTTP/1.1 200 OK\r\nX: ", drops(b"x")),
        (b"", drops(b"HTTP/1.1 100 Continue\r\n\r\n")),
    ],
    ids=["chunks", "body", "head", "interim"],
)
def test_an_answer_that_comes_in_drops_takes_no_longer_than_its_call_may(
    engine: Callable[..., Client], head: bytes, body: Iterator[bytes]
) -> None:
    def answer(_: bytes) -> Iterator[bytes]:
        yield head
        yield from body

    before = time.monotonic()
    with pytest.raises(requests.RequestException, match="timed out"):
        engine(answer, 0.2).info()
    assert time.monotonic() - before < 20


def test_a_stream_goes_on_for_longer_than_a_call_may(engine: Callable[..., Client]) -> None:
    def answer(_: bytes) -> Iterator[bytes]:
        yield CHUNKED
        yield from drops(b'9\r\n{"a": 1}\n\r\n', 0.1)

    events = engine(answer, 0.5).events(decode=True)
    assert [next(events) for _ in range(8)] == [{"a": 1}] * 8


def test_nobody_is_asked_whom_an_engine_names(engine: Callable[..., Client]) -> None:
    asked = []

    def answer(request: bytes) -> Iterator[bytes]:
        asked.append(request.split()[1])
        yield b"HTTP/1.1 302 Found\r\nLocation: /elsewhere\r\nContent-Length: 2\r\n\r\n{}"

    assert engine(answer).info() == {}
    assert asked == [b"/v1.41/info"]


def test_events_come_one_by_one_and_their_silence_has_an_end(engine: Callable[..., Client]) -> None:
    """The library waits for them without end: of a stream that was cut in silence nobody would know."""

    def answer(_: bytes) -> Iterator[bytes]:
        yield CHUNKED
        yield b'b\r\n{"a": 1}\n{"\r\n9\r\na": 2}\r\n\n\r\n'

    events = engine(answer, 1.0).events(decode=True)
    assert [next(events), next(events)] == [{"a": 1}, {"a": 2}]
    with pytest.raises((urllib3.exceptions.HTTPError, OSError)):
        next(events)


def test_a_message_that_never_ends_costs_no_memory(
    engine: Callable[..., Client], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(clients, "MOST_MESSAGE", 1 << 18)

    def answer(_: bytes) -> Iterator[bytes]:
        yield CHUNKED
        yield from chunks(b"[" * 65_536)

    assert list(engine(answer).events(decode=True)) == []


def test_of_a_log_no_more_is_taken_at_once_than_a_piece(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("_get_raw_response_socket", "_disable_socket_timeout"):
        monkeypatch.setattr(Client, name, lambda *_: None)
    sent = b"\1\0\0\0\0\0\0\3one" + b"\2\0\0\0\0\0\0\3two" + b"\1\0\0\0\xff\xff\xff\xff" + b"x" * 200_000
    answer: Any = SimpleNamespace(raw=io.BytesIO(sent))
    with contextlib.closing(Client("unix:///nowhere", version="1.41", timeout=1)) as client:
        pieces = list(client._multiplexed_response_stream_helper(answer))  # noqa: SLF001 the SDK calls it for logs
    assert pieces[:2] == [b"one", b"two"]
    assert [len(piece) for piece in pieces[2:]] == [65_536, 65_536, 65_536, 200_000 - 3 * 65_536]


def test_a_long_story_is_cut(engine: Callable[..., Client], tmp_path: Path) -> None:
    def answer(_: bytes) -> Iterator[bytes]:
        yield b"HTTP/1.1 200 OK\r\nContent-Length: 100000\r\n" + b"X: " + b"y" * 100_000 + b"\r\n\r\n"

    engine(answer)
    ours = Engine(DockerOptions(engine=f"unix://{tmp_path}/engine.sock"))
    with pytest.raises(SiteSilentError) as told:
        ours.api()
    assert len(str(told.value)) < 3000


def whole(body: bytes, status: bytes = b"200 OK") -> Answer:
    head = b"HTTP/1.1 %s\r\nContent-Type: application/json\r\nContent-Length: %d\r\n\r\n" % (status, len(body))
    return lambda _: iter((head, body))


@pytest.mark.parametrize("item", [b"[],", b"{},", b"1.5,"])
def test_a_document_of_very_many_values_costs_no_memory(item: bytes) -> None:
    """Each takes 30 times its bytes, and the time of all that is under way."""
    with pytest.raises(requests.ConnectionError, match="an answer of more than 500000 values"):
        document(b"[" + 500_000 * item + b"0]")


def test_a_message_of_very_many_values_ends_its_stream(engine: Callable[..., Client]) -> None:
    message = b'{"a": [' + b"[]," * 30_000 + b"0]}\n"

    def answer(_: bytes) -> Iterator[bytes]:
        yield CHUNKED + b"%x\r\n%s\r\n" % (len(message), message)

    assert list(engine(answer).events(decode=True)) == []


def test_half_a_character_is_another_one_and_a_whole_one_stays(engine: Callable[..., Client]) -> None:
    """No database takes it, and no answer of the API could hold it."""
    text = rb'{"message": "\ud800 \uDC00 \ud83e\udd16", "number": 7}'
    assert engine(whole(text)).info() == {"message": "? ? \N{ROBOT FACE}", "number": 7}


def test_half_a_character_of_a_refusal_is_another_one(engine: Callable[..., Client]) -> None:
    with pytest.raises(APIError) as error:
        engine(whole(rb'{"message": "\ud800"}', b"500 No")).info()
    assert error.value.explanation == "?"


def test_of_a_refusal_less_is_read_than_of_an_answer(
    engine: Callable[..., Client], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It need not say which characters it is of, and to guess that takes seconds for 32 MiB."""
    monkeypatch.setattr(clients, "MOST_REFUSAL", 1000)
    with pytest.raises(requests.ConnectionError, match="an answer of more than"):
        engine(whole(bytes(range(256)) * 8, b"500 No")).info()


def test_what_is_no_json_is_no_answer(engine: Callable[..., Client]) -> None:
    with pytest.raises(requests.RequestException, match="an answer that is no JSON"):
        engine(whole(b"[" * 100_000)).info()


@pytest.mark.parametrize(
    "answer", [b"5", b"null", b"[1]", b'{"Volumes": 5}', b'{"Volumes": [5]}', b'{"Volumes": [{}]}']
)
def test_an_answer_of_another_shape_is_the_sites_failure(
    engine: Callable[..., Client], tmp_path: Path, answer: bytes
) -> None:
    """Whatever it is: threads that look at a site ended with it."""

    def say(asked: bytes) -> Iterator[bytes]:
        return whole(answer if b"volumes" in asked else b'{"ApiVersion": "1.41"}')(asked)

    engine(say)
    ours = Engine(DockerOptions(engine=f"unix://{tmp_path}/engine.sock"))
    try:
        with pytest.raises(RuntimeFailure, match="is not understood"):
            remove_left(ours, "owner")
    finally:
        ours.drop()
