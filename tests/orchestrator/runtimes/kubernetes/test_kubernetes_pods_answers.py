"""What a pod may answer when it is asked for its reports or health: it is its service's, who may be hostile."""

from __future__ import annotations

import contextlib
import gzip
import json
import socket
import threading
import time
import tracemalloc
from collections.abc import Callable, Iterator
from itertools import chain, count, repeat
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest

from skytether.orchestrator.runtimes.kubernetes import health, reports
from skytether.orchestrator.runtimes.kubernetes.cluster import Cluster
from skytether.orchestrator.runtimes.kubernetes.health import FAILS, Health
from skytether.orchestrator.runtimes.kubernetes.options import KubernetesOptions
from skytether.orchestrator.runtimes.kubernetes.reports import ReportReader
from skytether.orchestrator.runtimes.kubernetes.seen import PodState

HEAD = b"HTTP/1.1 200 OK\r\nContent-Type: application/json\r\n"
CHUNKED = HEAD + b"Transfer-Encoding: chunked\r\n\r\n"
HONEST = b'{"reports": [{"number": 1, "code": "well", "message": "All is well."}]}'
Answer = Callable[[], Iterator[bytes]]


@pytest.fixture
def cluster(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Cluster]]:
    """A cluster whose API server passes on what these pods answer, piece by piece; others are honest."""
    monkeypatch.setattr(reports, "TIMEOUT_S", 0.5)
    opened: list[socket.socket] = []
    made: list[Cluster] = []

    def make(**answers: Answer) -> Cluster:
        listener = socket.create_server(("127.0.0.1", 0))
        opened.append(listener)

        def answer(taken: socket.socket) -> None:
            with contextlib.suppress(OSError), taken:
                pod = taken.recv(65_536).partition(b"/pods/")[2].partition(b":")[0].decode()
                for piece in answers[pod]() if pod in answers else [plain(HONEST)]:
                    taken.sendall(piece)

        def serve() -> None:
            with contextlib.suppress(OSError):
                while True:
                    opened.append(listener.accept()[0])
                    threading.Thread(target=answer, args=opened[-1:], daemon=True).start()

        threading.Thread(target=serve, daemon=True).start()
        here = f"http://127.0.0.1:{listener.getsockname()[1]}"
        document = {
            "current-context": "c",
            "contexts": [{"name": "c", "context": {"cluster": "c", "user": "u"}}],
            "clusters": [{"name": "c", "cluster": {"server": here}}],
            "users": [{"name": "u", "user": {"token": "secret"}}],
        }
        (tmp_path / "kubeconfig").write_text(json.dumps(document))
        made.append(Cluster(KubernetesOptions(kubeconfig=str(tmp_path / "kubeconfig"), timeout_s=10)))
        return made[-1]

    yield make
    for one in opened:
        with contextlib.suppress(OSError):
            one.shutdown(socket.SHUT_RDWR)
        one.close()
    for client in made:
        client.close()


def plain(body: bytes, head: bytes = HEAD) -> bytes:
    return head + b"Content-Length: %d\r\n\r\n" % len(body) + body


def drops(head: bytes, drop: bytes) -> Iterator[bytes]:
    yield head
    for _ in range(10_000):
        yield drop
        time.sleep(0.02)


def look(reader: ReportReader, pod: str = "honest") -> None:
    """Until there is something of a pod."""
    until = time.monotonic() + 20
    while not reader.of(pod):
        assert time.monotonic() < until, "it is kept from being read"
        reader.begin()
        time.sleep(0.01)


@pytest.mark.parametrize(
    "answer",
    [
        lambda: drops(CHUNKED, b"1\r\n \r\n"),
        lambda: drops(HEAD + b"Content-Length: 60000\r\n\r\n", b" "),
        lambda: drops(HEAD + b"\r\n", b" "),
        lambda: drops(b"", b"HTTP/1.1 100 Continue\r\n\r\n"),
        lambda: drops(HEAD + b"X: ", b"x"),
        lambda: drops(b"HTTP/1.1 500 No\r\nContent-Length: 60000\r\n\r\n", b" "),
    ],
    ids=["chunks", "body", "without length", "interim", "head", "failure"],
)
def test_a_pod_that_answers_in_drops_holds_up_nobody(cluster: Callable[..., Cluster], answer: Answer) -> None:
    reader = ReportReader(cluster(hostile=answer), lambda: ["hostile", "honest"])
    before = time.monotonic()
    look(reader)
    assert time.monotonic() - before < 10
    assert not reader.of("hostile")
    reader.close()


def test_many_pods_that_answer_in_drops_take_a_part_of_the_time_only(cluster: Callable[..., Cluster]) -> None:
    now = count(1000, 1000)  # whenever it is asked, a look is due
    asked: list[str] = []

    def answer(pod: str) -> Iterator[bytes]:
        asked.append(pod)
        return drops(CHUNKED, b"1\r\n \r\n")

    names = [f"hostile{number}" for number in range(3)]
    api = cluster(**{name: lambda name=name: answer(name) for name in names})
    reader = ReportReader(api, lambda: [*names, "honest", "newcomer"][: 5 if reader.of("honest") else 4], now.__next__)
    look(reader)
    before = time.monotonic()
    look(reader, "newcomer")
    assert time.monotonic() - before < 2
    assert asked == names
    reader.close()


def test_a_pod_that_answers_without_end_or_packed_costs_no_memory(cluster: Callable[..., Cluster]) -> None:
    bomb = gzip.compress(gzip.compress(bytes(64 << 20)))
    once = gzip.compress(b" " * (31 << 20))
    large = [
        plain(b" " * (31 << 20)),
        plain(once, HEAD + b"Content-Encoding: gzip\r\n"),
        plain(bomb, HEAD + b"Content-Encoding: gzip, gzip\r\n"),
    ]
    answers: dict[str, Answer] = {f"large{i}": lambda i=i: iter(large[i : i + 1]) for i in range(3)}  # type: ignore[misc]
    answers["endless"] = lambda: chain([CHUNKED], repeat(b"10000\r\n%s\r\n" % bytes(0x10000)))
    reader = ReportReader(cluster(**answers), lambda: [*answers, "honest"])
    tracemalloc.start()
    look(reader)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 8 << 20
    reader.close()


def test_nobody_is_asked_whom_a_pod_names(cluster: Callable[..., Cluster]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as elsewhere:
        elsewhere.setblocking(False)
        there = b"Location: http://localhost:%d/\r\n" % elsewhere.getsockname()[1]
        answer = plain(b"{}", b"HTTP/1.1 302 Found\r\n" + there)
        reader = ReportReader(cluster(hostile=lambda: iter([answer])), lambda: ["hostile", "honest"])
        look(reader)
        with pytest.raises(BlockingIOError):
            elsewhere.accept()
    reader.close()


def pod(name: str) -> PodState:
    return cast(PodState, SimpleNamespace(name=name, uid=f"uid-{name}"))


def says(**document: object) -> Answer:
    return lambda: iter([plain(json.dumps(document).encode())])


def test_who_is_well_although_its_node_says_otherwise_runs_on_and_who_is_not_says_why(
    cluster: Callable[..., Cluster], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(health, "EVERY_S", 0.0)
    monkeypatch.setattr(health, "TIMEOUT_S", 0.2)
    pods: dict[str, Answer] = {
        "well": says(trouble=""),
        "hung": says(trouble="its loop has hung for 12 s"),
        "old": says(reports=[]),
        "stranger": lambda: iter([b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\n\r\n"]),
        "silent": lambda: drops(CHUNKED, b"1\r\n \r\n"),
        "refused": lambda: iter([b"HTTP/1.1 503 No\r\nContent-Length: 0\r\n\r\n"]),
        "hostile": lambda: iter([plain(b"[" * 60_000)]),
    }
    api = cluster(**pods)
    told = threading.Event()
    doubts = Health(api, told.set)
    ill = {"hung": "its loop has hung for 12 s"} | dict.fromkeys(
        ["old", "stranger", "silent", "refused", "hostile"], FAILS
    )
    until = time.monotonic() + 20
    while (found := {name: doubts.trouble(pod(name), True) for name in pods}) != {"well": "", **ill}:
        assert time.monotonic() < until, found
        time.sleep(0.01)
    assert told.is_set()
    assert doubts.trouble(pod("hung"), False) == ""  # which its node says first
    doubts.keep({"uid-old"})
    doubts.close()
    assert [doubts.trouble(pod(name), True) for name in ("old", "silent")] == [FAILS, ""]


def test_where_the_api_server_is_silent_too_nothing_is_known(
    cluster: Callable[..., Cluster], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(health, "EVERY_S", 0.0)
    monkeypatch.setattr(health, "TIMEOUT_S", 0.1)
    asked: list[str] = []

    def nothing(name: str) -> Iterator[bytes]:
        asked.append(name)
        yield b"HTTP/1.1 503 No\r\nContent-Length: 0\r\n\r\n"

    # The empty name: what is asked of the API server itself.
    api = cluster(silent=lambda: nothing("silent"), **{"": lambda: nothing("")})
    doubts = Health(api, lambda: pytest.fail("something is known"))
    until = time.monotonic() + 20
    while asked.count("") < 2:
        assert doubts.trouble(pod("silent"), True) == ""
        assert time.monotonic() < until
        time.sleep(0.01)
    doubts.close()
