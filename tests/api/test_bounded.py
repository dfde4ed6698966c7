"""Answers that never end, or are too much: a server that is the enemy, on real sockets."""

import json
import socket
import threading
import time
import zlib
from contextlib import closing, suppress

import pytest

from skytether.api.client import ApiError, Client, Unreachable

HEAD = b"HTTP/1.1 200 OK\r\ncontent-type: application/json\r\n"
STEP_S = 0.2


def for_ever(link, piece, pause=0.0):
    while True:
        link.sendall(piece)
        time.sleep(pause)


def answer(link, body, status="200 OK", more=""):
    head = f"HTTP/1.1 {status}\r\ncontent-type: application/json\r\n{more}content-length: {len(body)}\r\n\r\n"
    link.sendall(head.encode() + body)


def huge(link):
    link.sendall(HEAD + b"content-length: 4000000000\r\n\r\n")
    for_ever(link, b" " * 65536)


def chunks_without_end(link):
    link.sendall(HEAD + b"transfer-encoding: chunked\r\n\r\n")
    for_ever(link, b"10000\r\n" + b" " * 65536 + b"\r\n")


def error_without_end(link):
    link.sendall(b"HTTP/1.1 500 No\r\ntransfer-encoding: chunked\r\n\r\n")
    for_ever(link, b"10000\r\n" + b" " * 65536 + b"\r\n")


def a_body_that_dribbles(link):
    link.sendall(HEAD + b"content-length: 4000\r\n\r\n")
    for_ever(link, b" ", 0.02)


def headers_that_dribble(link):
    link.sendall(HEAD)
    for_ever(link, b"x-more: y\r\n", 0.02)


def interim_answers_without_end(link):
    for_ever(link, b"HTTP/1.1 100 Continue\r\n\r\n", 0.001)


def packed(link):
    packer = zlib.compressobj(9, zlib.DEFLATED, 31)
    body = packer.compress(b" " * (1 << 22)) + packer.flush()
    answer(link, body, more="content-encoding: gzip\r\n")


@pytest.fixture
def serve():
    """Starts a server that does one thing to all that ask it."""
    opened = []

    def start(behave):
        door = socket.create_server(("127.0.0.1", 0))
        opened.append(door)

        def run():
            with suppress(OSError):
                while True:
                    threading.Thread(target=one, args=(door.accept()[0],), daemon=True).start()

        def one(link):
            with closing(link), suppress(OSError):
                while link.recv(65536):
                    behave(link)

        threading.Thread(target=run, daemon=True).start()
        return f"http://127.0.0.1:{door.getsockname()[1]}"

    yield start
    for door in opened:
        door.shutdown(socket.SHUT_RDWR)
        door.close()


@pytest.mark.slow
@pytest.mark.parametrize(
    "behave",
    [
        huge,
        chunks_without_end,
        error_without_end,
        a_body_that_dribbles,
        headers_that_dribble,
        interim_answers_without_end,
        packed,
    ],
)
def test_no_answer_is_waited_for_without_end_or_kept_whatever_its_size(serve, behave):
    before = time.monotonic()
    with (
        Client(serve(behave), "token", timeout=STEP_S, largest=1 << 20) as client,
        pytest.raises(Unreachable, match=r"is no orchestrator|no orchestrator answers"),
    ):
        client.get_instance("i1")
    assert time.monotonic() - before < 20 * STEP_S  # four steps, on a machine that is busy


@pytest.mark.parametrize("body", [b"[" * 100_000 + b"]" * 100_000, b'{"a":' * 100_000, b"9" * 6000])
def test_json_that_no_reader_can_read_is_a_strange_answer(serve, body):
    with Client(serve(lambda link: answer(link, body))) as client, pytest.raises(ApiError, match="not understood"):
        client.get_instance("i1")


def test_what_an_orchestrator_says_is_cut_and_holds_no_codes_for_a_terminal(serve):
    said = {"title": "Strange", "status": 409, "detail": "\x1b[2Jit is\x07\n" * 100_000}
    url = serve(lambda link: answer(link, json.dumps(said).encode(), "409 No"))
    with Client(url) as client, pytest.raises(ApiError) as error:
        client.get_instance("i1")
    text = str(error.value)
    assert len(text) < 20_000
    assert text.startswith("\\x1b[2Jit is\\x07\n")
    assert "\x1b" not in text
