"""Whoever has taken an orchestrator over, and has its keys, takes no node's memory, files or identity."""

from __future__ import annotations

import asyncio
import contextlib
import resource
import socket
import ssl
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from node_scene import first_line, program, until

from skytether.api.node import Issued, Link, Linked, Renew, line_of, read_request
from skytether.node import calls, run
from skytether.node.store import NodeConfig, NodeError, NodeStore, new_key, request_for
from skytether.orchestrator.nodes.authority import Authority, pem_of

Answers = Callable[[ssl.SSLSocket], object]
_ROOM = 1 << 14
"""Bytes that a kernel keeps of what nobody takes: few, so that it is seen soon."""


@dataclass
class Hostile:
    """Answers in an orchestrator's place, with its keys."""

    authority: Authority
    store: NodeStore
    url: str
    answers: dict[type, Answers] = field(default_factory=dict)
    """By what was asked."""

    def issue(self, key: Any, authority: Authority | None = None) -> str:
        return pem_of((authority or self.authority).sign(request_for(key), "edge", 30))

    def linked(self, **changes: Any) -> bytes:
        now = time.time()
        return line_of(Linked(**{"time": now, "begins": now, "ends": now + 1e6, **changes}))

    def stay(self, link: ssl.SSLSocket, **changes: Any) -> None:
        """Be linked until the node ends."""
        link.sendall(self.linked(**changes))
        while link.recv(1 << 16):
            pass


@pytest.fixture
def hostile(tmp_path: Path) -> Iterator[Hostile]:
    (tmp_path / "keys").mkdir()
    authority = Authority(tmp_path / "keys", time.time)
    context = authority.server_context()
    with socket.socket() as listener:
        for option in (socket.SO_RCVBUF, socket.SO_SNDBUF):
            listener.setsockopt(socket.SOL_SOCKET, option, _ROOM)
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        url = f"https://127.0.0.1:{listener.getsockname()[1]}"
        made = Hostile(authority, NodeStore(tmp_path / "node"), url)

        def serve(taken: socket.socket) -> None:
            with contextlib.suppress(OSError), taken, context.wrap_socket(taken, server_side=True) as link:
                asked = type(read_request(first_line(link)))
                made.answers.get(asked, lambda _: None)(link)

        def listen() -> None:
            with contextlib.suppress(OSError):
                while True:
                    threading.Thread(target=serve, args=(listener.accept()[0],), daemon=True).start()

        threading.Thread(target=listen, daemon=True).start()
        key = new_key()
        config = NodeConfig(name="edge", urls=(url,), engine=str(tmp_path / "engine.sock"), address="127.0.0.1")
        made.store.join(config, authority.pem, key, made.issue(key))
        yield made
        listener.shutdown(socket.SHUT_RDWR)


def test_who_asks_all_the_time_and_takes_no_answer_is_not_heard_on(hostile: Hostile) -> None:
    """Else the answers would wait in the node's memory, of which a machine at the edge has little."""
    waits, over = threading.Event(), threading.Event()

    def ask(link: ssl.SSLSocket) -> None:
        link.sendall(hostile.linked())
        link.settimeout(2)
        try:
            for _ in range(4000):
                link.sendall(b'{"ping": 123456789012345678}\n' * 100)
        except TimeoutError:
            waits.set()
        over.set()

    hostile.answers[Link] = ask
    with program(hostile.store):
        assert over.wait(60)
    assert waits.is_set()


def test_of_addresses_that_an_orchestrator_tells_few_are_kept_and_no_odd_one(
    hostile: Hostile, caplog: pytest.LogCaptureFixture
) -> None:
    odd = ("https://a\nfalse line", "ftp://a", "https://a:99999", "https://\x1b[31m", "https://" + "a" * 300)
    many = (*odd, *(f"https://127.0.0.1:{port}" for port in range(1, 1000)))
    told = threading.Event()

    def tell(link: ssl.SSLSocket) -> None:
        link.sendall(hostile.linked(urls=many))
        told.wait(30)

    hostile.answers[Link] = tell
    with program(hostile.store) as linked:
        until(lambda: linked)
        kept = until(lambda: len(urls := hostile.store.config().urls) > 1 and urls)
        told.set()
    assert len(kept) == 16
    assert not set(kept) & set(odd)
    assert not any("\n" in line or "\x1b" in line for line in caplog.messages)


@pytest.mark.parametrize("odd", ["nothing", "garbage", "of another key", "by another authority"])
def test_what_is_no_certificate_of_the_node_takes_its_own_from_nobody(
    hostile: Hostile, odd: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """It would be no site any more, also where the orchestrator is the operator's again."""
    (tmp_path / "false").mkdir()
    false = Authority(tmp_path / "false", time.time)
    key, before = new_key(), hostile.store.identity.read_bytes()
    given = {
        "nothing": "",
        "garbage": "-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n",
        "of another key": hostile.issue(new_key()),
        "by another authority": hostile.issue(key, false),
    }[odd]
    with pytest.raises(NodeError, match="is not kept"):
        hostile.store.renew(key, given)
    hostile.answers[Renew] = lambda link: link.sendall(line_of(Issued(name="edge", certificate=given)))
    hostile.answers[Link] = lambda link: hostile.stay(link, time=time.time() + 1e8)
    with program(hostile.store):
        until(lambda: any("is not kept" in line for line in caplog.messages))
    assert hostile.store.identity.read_bytes() == before
    hostile.store.renew(key, hostile.issue(key))
    assert hostile.store.identity.read_bytes() != before


@pytest.mark.parametrize("left", ["left", "left, and joined another"])
def test_who_has_left_is_linked_no_more_whatever_an_orchestrator_says(
    hostile: Hostile, left: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where no unit runs the node's program, and nobody ended that."""
    monkeypatch.setattr(run, "LOOK_S", 0.05)
    linked, ended = threading.Event(), threading.Event()

    def stay(link: ssl.SSLSocket) -> None:
        linked.set()
        hostile.stay(link)
        ended.set()

    hostile.answers[Link] = stay
    node = threading.Thread(target=lambda: asyncio.run(run.NodeProgram(hostile.store).run()), daemon=True)
    node.start()
    assert linked.wait(30)
    config = hostile.store.config()
    hostile.store.clear()
    if left != "left":
        (tmp_path / "other").mkdir()
        other, key = Authority(tmp_path / "other", time.time), new_key()
        hostile.store.join(config, other.pem, key, hostile.issue(key, other))
    assert ended.wait(30)
    node.join(30)
    assert not node.is_alive()


def test_an_answer_in_drops_takes_no_longer_than_another(hostile: Hostile, monkeypatch: pytest.MonkeyPatch) -> None:
    """A node renews with one orchestrator at a time: the others would wait until its certificate is over."""
    monkeypatch.setattr(calls, "ANSWER_S", 0.2)

    def drip(link: ssl.SSLSocket) -> None:
        for _ in range(400):
            link.sendall(b" ")
            time.sleep(0.05)

    hostile.answers[Renew] = drip
    trust = calls.trusting(hostile.store.authority(), hostile.store.identity)
    began = time.monotonic()
    with pytest.raises(calls.UnreachableError):
        calls.call(hostile.url, trust, Renew(request=request_for(new_key())), Issued)
    assert time.monotonic() - began < 10


def test_a_node_has_as_many_files_as_its_ways_take(hostile: Hostile) -> None:
    """The thousand that most programs begin with are used up by one orchestrator's ways, and no other is linked."""
    hostile.answers[Link] = hostile.stay
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(1024, hard), hard))
    try:
        with program(hostile.store) as linked:
            until(lambda: linked)
            assert resource.getrlimit(resource.RLIMIT_NOFILE)[0] >= min(hard, 65_536)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
