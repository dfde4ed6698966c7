"""Who may come in, and who gives way."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import math
import socket
import ssl
import weakref
from asyncio.sslproto import SSLProtocol
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from certificates import certificate
from deep_size import deep_size
from uvicorn import Config
from uvicorn.server import ServerState

from skytether.api.splice import closed
from skytether.orchestrator.config.settings import ServerLimits
from skytether.orchestrator.domain.overload import Overload
from skytether.orchestrator.http.connections import Acceptor, Connection, ConnectionTable, GuardedProtocol, place_of


def table(most: int = 100, **limits: int) -> ConnectionTable:
    return ConnectionTable(ServerLimits(**limits), most)


def came(at: ConnectionTable, address: str = "a", owner: str = "", deadline: float = math.inf) -> Connection:
    connection = Connection(address, deadline, lambda *_: None)
    at.come(connection)
    if owner:
        at.know(connection, owner)
    return connection


def test_of_all_the_oldest_without_a_token_gives_way_and_nobody_with_one() -> None:
    at = table(most=3)
    came(at, owner="robot:a")
    old = came(at, "b")
    came(at, "c")
    assert at.room("d") == (True, old)
    at.leave(old)
    assert at.room("d") == (True, None)
    came(at, "d", owner="robot:d")
    assert at.room("e") == (True, at.stranger())
    stranger = at.stranger()
    assert stranger is not None
    at.know(stranger, "robot:c")
    assert at.room("e") == (False, None)


def test_one_address_has_its_share_unless_it_is_a_proxys() -> None:
    at = table(connections_per_address=2)
    first = came(at, "a")
    came(at, "a")
    assert at.room("a") == (True, first)
    assert at.room("b") == (True, None)
    assert at.room("a", free=True) == (True, None)
    for connection in list(at.connections):
        at.know(connection, "robot:x")
    assert at.room("a") == (False, None)


def test_of_a_robots_connections_the_one_that_was_quiet_for_longest_gives_way() -> None:
    at = table(connections_per_robot=2)
    first, second = came(at, owner="robot:a"), came(at, owner="robot:a")
    at.know(first, "robot:a")
    third = came(at)
    assert at.know(third, "robot:a") is second
    at.leave(second)
    first.busy = True
    fourth = came(at)
    assert at.know(fourth, "robot:a") is third
    many: list[Any] = [came(at, owner="operator") for _ in range(5)]
    assert all(at.know(one, "operator") is None for one in many)


def test_those_who_left_are_forgotten() -> None:
    at = table()
    sizes = []
    for number in range(50):
        connections = [came(at, f"a{number}"), came(at, "b", f"robot:{number}"), came(at, "b", "robot:c")]
        at.know(connections[2], "robot:b")
        for connection in [*connections, *connections]:
            at.leave(connection)
        at.know(connections[0], "robot:a")
        assert at.connections == set()
        sizes.append(deep_size(at))
    assert max(sizes[25:]) <= max(sizes[:25])


def test_of_strangers_the_oldest_of_the_largest_crowd_gives_way() -> None:
    at = table(strangers=4)
    robot = came(at, "robot")
    crowd = [came(at, "crowd") for _ in range(3)]
    assert [at.is_alone(one) for one in (robot, *crowd)] == [True, False, False, False]
    assert at.room("other") == (True, crowd[0])
    at.leave(crowd[0])
    assert at.room("other") == (True, None)
    came(at, "crowd")
    at.know(robot, "robot:a")
    assert at.room("other") == (True, None), "who has shown a token counts no more"
    came(at, "other")
    assert at.room("robot") == (True, crowd[1])


def test_late_is_who_owes_something_or_does_not_take_what_it_was_sent() -> None:
    at = table()
    owes, takes, waits = came(at, deadline=5), came(at), came(at)
    takes.takes_by = 7
    assert at.late(4.9) == []
    assert at.late(5) == [owes]
    assert set(at.late(7)) == {owes, takes}
    assert waits not in at.late(1e9)


def test_one_customers_network_is_one_address() -> None:
    assert place_of("2001:db8:1:2:aaaa::1") == place_of("2001:db8:1:2::9") != place_of("2001:db8:1:3::9")
    assert place_of("::ffff:192.0.2.7") == "192.0.2.7" == place_of("192.0.2.7")
    assert place_of("fe80::1%eth0") == place_of("fe80::2%eth0")
    assert place_of("unix") == "unix"


async def answers_to(
    *asked: bytes, make: type[GuardedProtocol] = GuardedProtocol, end: bytes = b""
) -> tuple[bytes, list[str]]:
    """All that a real connection is sent, until it is closed or ends as told, and the paths that were served.

    Each part of what is asked is sent, and read, for itself, before there is an answer.
    """
    served: list[str] = []
    sent = asyncio.Event()

    async def app(scope: Any, receive: Any, send: Any) -> None:
        served.append(scope["path"])
        await sent.wait()
        await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"2")]})
        await send({"type": "http.response.body", "body": b"ok"})

    config = Config(app, http=GuardedProtocol, log_config=None, lifespan="off")
    config.load()
    with socket.create_server(("127.0.0.1", 0)) as listener:
        door = Acceptor(
            listener,
            lambda: make(config, ServerState(), {}),
            None,
            ServerLimits(idle_s=0.5),
            100,
            (),
            Overload(),
        )
        try:
            reader, writer = await asyncio.open_connection(*listener.getsockname())
            for part in asked:
                writer.write(part)
                await asyncio.sleep(0.02)
            sent.set()
            answers = b""
            with contextlib.suppress(OSError):
                answers = await (reader.readuntil(end) if end else reader.read())
            writer.close()
        finally:
            door.close()
            await door.wait_closed()
    return answers, served


def test_a_connection_leaves_nothing_that_waits_for_the_collector() -> None:
    made: list[weakref.ref[GuardedProtocol]] = []

    class Watched(GuardedProtocol):
        def connection_made(self, transport: Any) -> None:
            made.append(weakref.ref(self))
            super().connection_made(transport)

    gc.disable()
    try:
        answer, served = asyncio.run(answers_to(get("/a"), make=Watched, end=OK))
        assert (answer[-2:], served) == (b"ok", ["/a"])
        assert [protocol() for protocol in made] == [None]
    finally:
        gc.enable()


def get(path: str) -> bytes:
    return f"GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode()


@pytest.mark.parametrize("asked", [(get("/a") + get("/b") * 3,), (get("/a"), get("/b"), get("/c"), b"GET /d HT", b"!")])
def test_a_request_before_the_last_answer_ends_the_connection_after_that_answer(asked: tuple[bytes, ...]) -> None:
    answers, served = asyncio.run(answers_to(*asked))
    assert served == ["/a"]
    assert answers.count(b"HTTP/1.1 200") == 1
    assert b"connection: close" in answers
    assert answers.endswith(b"\r\n\r\nok")


def test_who_sends_on_and_on_instead_of_waiting_is_cut_off() -> None:
    answers, served = asyncio.run(answers_to(get("/a"), *(get("/b") * 5000,) * 4))
    assert (answers, served) == (b"", ["/a"])


OK = b"\r\n\r\nok"
TOO_LARGE = b"The request's headers are too large."


@pytest.mark.parametrize(
    "asked",
    [
        (b"GET / HTTP/1.1\r\n" + b"a:b\r\n" * 102,),
        (b"GET / HTTP/1.1\r\n", *(b"a:b\r\n" * 50,) * 3),
        (b"GET / HTTP/1.1\r\n" + b"a:" + b"b" * 60_000 + b"\r\n",),
        (b"GET / HTTP/1.1\r\na:" + b"b" * 70_000,),
        (b"GET / HTTP/1.1\r\na:", *(b"b" * 15_000,) * 4),
        (b"GET /" + b"b" * 40_000,),
        (b"GET /?" + b"b" * 20_000 + b" HTTP/1.1\r\na:" + b"b" * 13_000 + b"\r\nc:d",),
    ],
    ids=["many", "many later", "long", "without end", "without end later", "path", "in sum"],
)
def test_a_head_is_bounded_before_it_is_complete(asked: tuple[bytes, ...]) -> None:
    answers, served = asyncio.run(answers_to(*asked))
    assert (answers[:12], answers[-len(TOO_LARGE) :], served) == (b"HTTP/1.1 400", TOO_LARGE, [])


def test_heads_and_bodies_as_people_send_them_are_served() -> None:
    headers = b"Host: localhost\r\n" + b"".join(b"x-%d: %s\r\n" % (n, b"v" * 200) for n in range(98))
    head = b"GET /a?q=" + b"v" * 8_000 + b" HTTP/1.1\r\n" + headers + b"\r\n"
    answers, served = asyncio.run(answers_to(head, end=OK))
    assert (answers[:15], served) == (b"HTTP/1.1 200 OK", ["/a"])
    body = b"POST /b HTTP/1.1\r\nHost: localhost\r\nContent-Length: 100000\r\n\r\n" + b"v" * 100_000
    answers, served = asyncio.run(answers_to(body, end=OK))
    assert (answers[:15], served) == (b"HTTP/1.1 200 OK", ["/b"])


def test_what_comes_after_a_body_is_no_header() -> None:
    seen: list[Any] = []

    class Watched(GuardedProtocol):
        def on_message_complete(self) -> None:
            seen.extend(self.scope["headers"])
            super().on_message_complete()

    head = b"POST /a HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n"
    chunks = b"1\r\nx\r\n0\r\nauthorization: x\r\n\r\n"
    answers, served = asyncio.run(answers_to(head + chunks, make=Watched, end=OK))
    assert (answers[:15], served) == (b"HTTP/1.1 200 OK", ["/a"])
    assert [name for name, _ in seen] == [b"host", b"transfer-encoding"]


class Plain(asyncio.Protocol):
    """Does nothing."""


async def fail_a_handshake(tls: ssl.SSLContext) -> None:
    """Somebody begins to agree upon TLS, and leaves."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        context: Any = SimpleNamespace(context=tls)
        door = Acceptor(listener, Plain, context, ServerLimits(), 100, (), Overload())
        try:
            with socket.create_connection(listener.getsockname()) as stranger:
                stranger.send(b"\x16\x03\x01\x02\x00\x01\x00")
                while not door.table.connections:
                    await asyncio.sleep(0.005)
            while door.table.connections:
                await asyncio.sleep(0.005)
        finally:
            door.close()
            await door.wait_closed()
            await closed()


def test_a_handshake_that_failed_leaves_nothing_that_waits_for_the_collector(tmp_path: Path) -> None:
    """256 KiB each: strangers who came and went took a gigabyte and more."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(*certificate(tmp_path))
    others = {id(one): one for one in gc.get_objects() if isinstance(one, SSLProtocol)}  # of other tests' connections
    gc.disable()
    try:
        asyncio.run(fail_a_handshake(context))
        left = [one for one in gc.get_objects() if isinstance(one, SSLProtocol)]
        assert [one for one in left if id(one) not in others] == []
    finally:
        gc.enable()
