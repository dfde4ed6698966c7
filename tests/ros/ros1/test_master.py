"""Answers of a master that is none, or has gone mad: each is a MasterError, in time, and nothing else."""

import gzip
import socket
import threading
import time
from contextlib import contextmanager

import pytest

from skytether.ros.ros1.master import LARGEST, Master, MasterError, call
from skytether.ros.ros1.registry import Registry

XML = "<methodResponse><params><param>{}</param></params></methodResponse>"
GOOD = XML.format(
    "<value><array><data><value><int>1</int></value><value>ok</value><value>{}</value></data></array></value>"
)
NUMBER = GOOD.format("<int>0</int>")


def answer(body, headers=""):
    data = body if isinstance(body, bytes) else body.encode()
    return f"HTTP/1.1 200 OK\r\ncontent-type: text/xml\r\ncontent-length: {len(data)}\r\n{headers}\r\n".encode() + data


@contextmanager
def answering(*chunks, pause_s=0.0):
    """A server that says the same to everybody, chunk by chunk, the last one for ever if there is a pause."""
    ended = threading.Event()

    def serve(link):
        with link:
            try:
                link.recv(65536)
                for chunk in chunks:
                    link.sendall(chunk)
                while pause_s and not ended.wait(pause_s):
                    link.sendall(chunks[-1])
            except OSError:
                pass

    def run():
        while True:
            try:
                link, _ = listens.accept()
            except OSError:
                return
            threading.Thread(target=serve, args=(link,), daemon=True).start()

    with socket.create_server(("127.0.0.1", 0)) as listens:
        thread = threading.Thread(target=run)
        thread.start()
        try:
            yield f"http://127.0.0.1:{listens.getsockname()[1]}"
        finally:
            ended.set()
            listens.shutdown(socket.SHUT_RDWR)
            thread.join()


@pytest.mark.parametrize(
    "said",
    [
        b"",
        b"SSH-2.0-OpenSSH\r\n",
        b"HTTP/1.1 404 no\r\n\r\n",
        answer(""),
        answer("no XML at all"),
        answer("<?xml version='1.0' encoding='klingon'?>" + NUMBER),
        answer(XML.format("<value><int>1</int></value>")),
        answer(GOOD.format("<bigdecimal>x</bigdecimal>")),
        answer(GOOD.format("<struct><member></member><member><name>a</name></member></struct>")),
        answer("<methodResponse></data></array></value></param></methodResponse>"),
        answer("<value>" * 20_000),
        answer(gzip.compress(NUMBER.encode()), "content-encoding: gzip\r\n"),
        answer(b"\x1f\x8bno gzip", "content-encoding: gzip\r\n"),
    ],
)
def test_an_answer_that_is_none_is_an_error_of_the_master(said):
    with answering(said) as uri, pytest.raises(MasterError):
        call(uri, "getUri", "/me")


@pytest.mark.parametrize("said", [NUMBER, GOOD.format("<array><data><value><int>1</int></value></data></array>")])
@pytest.mark.parametrize(
    "ask",
    [
        lambda found: found.publishers("/t"),
        lambda found: found.topic_types(),
        lambda found: found.published(),
    ],
)
def test_an_answer_of_another_shape_is_an_error_of_the_master(said, ask):
    with answering(answer(said)) as uri, pytest.raises(MasterError):
        ask(Master(uri, "/me"))


def test_publishers_that_are_no_list_do_not_end_the_thread_that_registers():
    class Entry:
        name = "/t"

        def register(self, found):
            found.register_subscriber("/t", "std_msgs/Bool", "http://me/")

    with answering(answer(NUMBER)) as uri:
        registry = Registry(Master(uri, "/me"), "/me", lambda: "http://me/")
        registry.want(Entry())
        registry.step()
        assert registry.present is False


@pytest.mark.parametrize("begun", [b"HTTP/1.1 200 OK\r\n", answer(" " * 2000)[:-1000]])
def test_an_answer_that_dribbles_ends_in_time(begun):
    """Each read alone is in time."""
    with answering(begun, b"a", pause_s=0.02) as uri:
        since = time.monotonic()
        with pytest.raises(MasterError, match=r"timed out|does not end"):
            call(uri, "getUri", "/me", timeout=0.2)
        assert time.monotonic() - since < 10


def test_an_answer_without_end_is_not_kept():
    with (
        answering(b"HTTP/1.1 200 OK\r\n\r\n<methodResponse>", b" " * (LARGEST // 4), pause_s=0.001) as uri,
        pytest.raises(MasterError, match=f"more than {LARGEST} bytes"),
    ):
        call(uri, "getUri", "/me")


def test_a_good_answer_is_taken():
    with answering(answer(NUMBER)) as uri:
        assert call(uri, "getUri", "/me") == 0
