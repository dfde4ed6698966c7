"""Hostile nodes, machines that were removed, and whoever stands between a machine and its orchestrator."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import socket
import ssl
import tempfile
import threading
import time
from asyncio.sslproto import SSLProtocol
from pathlib import Path
from typing import Any

import pytest
from node_scene import MadeUpEngine, NodeScene, connection, context_of, first_line, linked_by, until

from skytether.api.client import Client
from skytether.api.node import (
    ALPN,
    GO,
    SERVER_NAME,
    Hello,
    Issued,
    Join,
    Link,
    Said,
    Standing,
    Stands,
    Way,
    Welcome,
    line_of,
)
from skytether.api.rest import InstanceCreate, SiteCreate
from skytether.node import calls, join
from skytether.node.calls import RefusedError, first_call, trusting
from skytether.node.store import NodeError, new_key, request_for
from skytether.orchestrator.config.settings import Settings, Timing
from skytether.orchestrator.core import Orchestrator
from skytether.orchestrator.http import node_echo
from skytether.orchestrator.http.app import create_app
from skytether.orchestrator.nodes import ways
from skytether.orchestrator.nodes.authority import Authority


def test_an_authority_of_somebody_elses_behind_the_true_one_is_not_believed(nodes: NodeScene, tmp_path: Path) -> None:
    """He passes on what the orchestrator says of itself, with an authority of his own behind it."""
    nodes.engine()
    token = nodes.invite()
    (tmp_path / "false").mkdir()
    false = Authority(tmp_path / "false", time.time)
    context = false.server_context()
    heard: list[bytes] = []
    true = nodes.core.authority.pem
    with socket.create_server(("127.0.0.1", 0)) as listener:
        url = f"https://127.0.0.1:{listener.getsockname()[1]}"

        def serve() -> None:
            with contextlib.suppress(OSError):
                while True:
                    taken, _ = listener.accept()
                    with contextlib.suppress(OSError), taken, context.wrap_socket(taken, server_side=True) as link:
                        line = first_line(link)
                        heard.append(line)
                        link.sendall(line_of(Welcome(time=time.time(), authority=true + false.pem)))

        threading.Thread(target=serve, daemon=True).start()
        with pytest.raises(NodeError, match="not the orchestrator"):
            join.join(nodes.options(token, urls=(url,)))
        listener.shutdown(socket.SHUT_RDWR)
    assert not any(token.encode() in line for line in heard)
    assert join.join(nodes.options(token)).name == "edge"


def test_a_machine_that_was_removed_does_not_take_the_place_of_the_next_one_of_its_name(nodes: NodeScene) -> None:
    """It asks again with the token and key by which it once joined, as if that answer had been lost."""
    token = nodes.invite()
    trust = trusting(first_call(nodes.url, token.partition(".")[2]).authority)
    asked = Join(token=token, request=request_for(new_key()), address="127.0.0.1")
    calls.call(nodes.url, trust, asked, Issued)
    nodes.operator.delete_site("edge", force=True)
    nodes.join()
    before = nodes.core.nodes.get("edge")
    with pytest.raises(RefusedError, match="was used at"):
        calls.call(nodes.url, trust, asked, Issued)
    assert nodes.core.nodes.get("edge").next_serial == before.next_serial


def test_a_node_cannot_have_more_ways_wanted_than_it_was_asked_for(nodes: NodeScene) -> None:
    """It says that minus ten thousand ways failed, then opens them: nobody else would have room."""
    nodes.join()
    trust = context_of(nodes.store())
    with connection(nodes, trust) as link, contextlib.ExitStack() as stack:
        secret = linked_by(link)
        link.sendall(b'{"failed": -10000}\n')
        for _ in range(3):
            way = stack.enter_context(connection(nodes, trust))
            way.sendall(line_of(Way(link=secret)))
            assert first_line(way)  # a refusal


def test_a_copy_of_a_nodes_key_gets_none_of_its_ways(nodes: NodeScene) -> None:
    """Beside the node he waits for the orchestrator to want one: calls to the engine have keys of sessions in them."""
    nodes.join()
    trust = context_of(nodes.store())
    with nodes.running() as linked, contextlib.ExitStack() as stack:
        until(lambda: linked and nodes.state() == "ready")
        for number in range(ways.SPARE + 2):
            way = stack.enter_context(connection(nodes, trust))
            way.sendall(line_of(Way()) if number % 2 else line_of(Way(link=32 * "0")))
            assert b"this way is of no link that stands" in first_line(way)
        nodes.core.sites.get("edge").runtime.engine.drop()  # type: ignore[attr-defined]
        until(lambda: nodes.state() == "ready")


@pytest.mark.parametrize(
    ("line", "rate", "most"),
    [(b'{"pong": 1}\n', "_LINES_PER_S", "_LINES"), (b'{"engine": "away"}\n', "_TURNS_PER_S", "_TURNS")],
    ids=["lines", "engine"],
)
def test_a_node_that_talks_without_end_is_heard_only_now_and_then(
    nodes: NodeScene, monkeypatch: pytest.MonkeyPatch, line: bytes, rate: str, most: str
) -> None:
    """All nodes are served by one loop, and each line takes its time: others were not linked any more."""
    monkeypatch.setattr(ways, rate, 0.01)
    monkeypatch.setattr(ways, most, 5)
    heard, on_message = [], ways.Ways._on_message  # noqa: SLF001 what is not heard shows nowhere
    monkeypatch.setattr(
        ways.Ways, "_on_message", lambda own, node, said: (heard.append(said), on_message(own, node, said))
    )
    nodes.shut()
    nodes.open()
    nodes.join("edge")
    nodes.join("other")
    heard.clear()
    with connection(nodes, context_of(nodes.store("other"))) as link:
        link.sendall(line_of(Link()))
        first_line(link)
        link.settimeout(0.2)
        with contextlib.suppress(TimeoutError):
            for _ in range(1000):  # until nothing more is taken of it
                link.sendall(1000 * line)
        assert len(heard) <= 5
        assert calls.call(nodes.url, context_of(nodes.store("edge")), Standing(), Stands).state == "unreachable"


def test_a_node_that_does_not_read_what_it_is_told_is_cut_off(
    nodes: NodeScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    nodes.join()
    monkeypatch.setattr(ways, "MOST_UNREAD", -1)
    with connection(nodes, context_of(nodes.store())) as link:
        link.sendall(line_of(Link()) + line_of(Said(engine="")))
        until(lambda: "it does not read what it is told" in nodes.operator.get_site("edge").reason)


def test_what_an_engine_says_beyond_measure_waits(nodes: NodeScene, monkeypatch: pytest.MonkeyPatch) -> None:
    """A node's machine has the bandwidth, and the orchestrator's loop has all nodes to serve."""
    monkeypatch.setattr(ways, "BYTES_PER_S", 1)
    monkeypatch.setattr(ways, "BYTES", 1 << 16)
    nodes.shut()
    nodes.open()
    nodes.join()
    path = nodes.core.settings.state_dir / "sites/edge/engine.sock"
    with connection(nodes, context_of(nodes.store())) as link, contextlib.ExitStack() as stack:
        secret = linked_by(link)
        link.sendall(line_of(Said(engine="")))
        until(path.exists)

        def asked() -> Any:
            """A way by which somebody asks, and does not only look whether there is one."""
            way = stack.enter_context(connection(nodes, context_of(nodes.store())))
            way.sendall(line_of(Way(link=secret)))
            return way if way.recv(1) == GO and way.recv(4096).startswith(b"GET") else None

        way = until(asked)
        way.settimeout(0.5)
        with pytest.raises(TimeoutError):
            way.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: 30000000\r\n\r\n" + b" " * 30_000_000)


# What an engine says of itself


LIES: tuple[dict[str, Any], ...] = (
    {"NCPU": float("inf")},
    {"NCPU": float("nan")},
    {"NCPU": -4},
    {"MemTotal": 10**80},
    {"Architecture": "\ud800"},
    {"Architecture": "x" * 100_000},
    {"SecurityOptions": [5]},
    {"SecurityOptions": 7},
)


def test_an_engine_that_lies_of_itself_is_its_sites_trouble_alone(server: Any, tmp_path: Path) -> None:
    """One such number, or half a character, and nobody was shown any site."""
    core = Orchestrator(Settings(state_dir=tmp_path / "state", timing=Timing(observe=0.02, place=0.05)))
    core.start()
    server.app = create_app(core)
    with contextlib.ExitStack() as stack:
        stack.callback(core.stop)
        short = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="sky-")))
        token = (tmp_path / "state/operator.token").read_text().strip()
        operator = stack.enter_context(Client(server.url, token))
        for number, lie in enumerate(LIES):
            engine = MadeUpEngine(short / f"{number}.sock", **lie)
            stack.callback(engine.stop)
            options = {"engine": f"unix://{engine.path}"}
            operator.create_site(SiteCreate(name=f"lies-{number}", tier="edge", runtime="docker", options=options))
        lying = [site for site in core.sites.all() if site.name != "local"]
        until(lambda: all(site.failure or site.capacity for site in lying))
        assert {site.name: site.state for site in operator.sites()}["local"] == "ready"
        assert operator.metrics()
        assert all(site.failure for site in lying if site.name != "lies-4"), "half a character is another one"


def test_of_a_machine_that_joined_it_is_known_which_robots_were_there(nodes: NodeScene) -> None:
    nodes.join()
    with nodes.running() as linked:
        until(lambda: linked and nodes.state() == "ready")
        assert nodes.core.sites.hosted("edge") == frozenset()
        made = nodes.operator.create_instance(InstanceCreate(robot="walker", service="toy", lease_s=1000))
        nodes.operator.wait_running(made.id)
        until(lambda: nodes.core.sites.hosted("edge") == {"walker"})
        nodes.operator.delete_instance(made.id)
        until(lambda: not nodes.operator.get_site("edge").instances)
        nodes.core.sites.get("edge").hosted = None  # opened anew
        until(lambda: nodes.core.sites.hosted("edge") == {"walker"})


def test_a_node_whose_name_takes_for_ever_to_resolve_keeps_nobody_waiting(
    nodes: NodeScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It says under which name its echo is, and has that resolved by a server of its own."""
    nodes.join("edge")
    ended = threading.Event()
    monkeypatch.setattr(node_echo, "echo_answers", lambda *_: ended.wait(30))
    monkeypatch.setattr(node_echo, "PATIENCE_S", 0.05)
    try:
        nodes.join("other", echo=free_port())
        hostile = context_of(nodes.store("other"))
        for _ in range(node_echo.ECHOES + 4):  # more than there are threads
            assert calls.call(nodes.url, hostile, Standing(), Stands).echo is None
        assert calls.call(nodes.url, context_of(nodes.store("edge")), Standing(), Stands).state == "unreachable"
        nodes.shut()  # nor whoever ends the orchestrator
    finally:
        ended.set()
    assert sum(thread.name == "node-echo" for thread in threading.enumerate()) <= node_echo.ECHOES


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


def test_a_handshake_that_failed_leaves_nothing_that_waits_for_the_collector(nodes: NodeScene) -> None:
    gc.collect()
    gc.disable()
    try:
        before = sum(isinstance(one, SSLProtocol) for one in gc.get_objects())
        for _ in range(3):
            with socket.create_connection(("127.0.0.1", nodes.port), timeout=10) as stranger:
                stranger.sendall(b"\x16\x03\x01\x02\x00\x01\x00")
                stranger.shutdown(socket.SHUT_WR)
                with contextlib.suppress(ConnectionError):
                    assert stranger.recv(100) == b""
        until(lambda: sum(isinstance(one, SSLProtocol) for one in gc.get_objects()) <= before)
    finally:
        gc.enable()


@pytest.mark.filterwarnings("error::ResourceWarning")
def test_who_comes_in_the_moment_the_door_is_closed_is_not_left_open(
    nodes: NodeScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The listener's loop sees who comes and that it is to end in one and the same turn."""
    opened: list[socket.socket] = []
    closes: list[threading.Thread] = []
    clock, known = nodes.core.clock, threading.Event()

    def busy() -> float:
        if threading.current_thread().name == "nodes" and known.is_set() and not closes:
            loop, told = asyncio.get_running_loop(), threading.Event()
            tell = loop.call_soon_threadsafe

            def tells(*given: Any) -> Any:
                handle = tell(*given)
                told.set()
                return handle

            monkeypatch.setattr(loop, "call_soon_threadsafe", tells)
            opened.append(socket.create_connection(("127.0.0.1", nodes.port), timeout=10))
            closes.append(threading.Thread(target=nodes.shut))
            closes[0].start()
            assert told.wait(10)
        return clock()

    nodes.shut()
    monkeypatch.setattr(nodes.core, "clock", busy)
    nodes.open()
    with contextlib.suppress(OSError), contextlib.closing(socket.create_connection(("127.0.0.1", nodes.port))) as first:
        context = ssl.create_default_context()
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
        context.set_alpn_protocols([ALPN])
        with context.wrap_socket(first, server_hostname=SERVER_NAME) as link:
            known.set()
            link.sendall(line_of(Hello()))
            link.recv(1)
    closes[0].join()
    with opened[0], contextlib.suppress(ConnectionError):
        assert opened[0].recv(1) == b""
