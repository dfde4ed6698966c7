"""Requests that are due whether or not those before were answered, over plain HTTP connections that are kept.

The client costs as little as it can, for it runs beside what it measures: the standard library's, one connection for
each thread.
"""

from __future__ import annotations

import http.client
import queue
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from urllib.parse import urlsplit

import numpy as np

_THREADS = 64
"""Requests under way at most; one that waits for a thread is late, and counts as such."""
_TIMEOUT_S = 30.0


@dataclass(frozen=True, slots=True)
class Request:
    """One request, and what is done with a good answer's body."""

    kind: str
    method: str
    path: str
    headers: Mapping[str, str] = field(default_factory=dict)
    body: bytes | None = None
    then: Callable[[bytes], None] = lambda _: None


@dataclass(frozen=True, slots=True)
class Answered:
    """What became of one."""

    kind: str
    seconds: float
    """From when it was due until all of its answer was read."""
    status: int
    """0: there was no answer."""

    @property
    def good(self) -> bool:
        return 200 <= self.status < 300


def ask_openly(
    url: str, next_request: Callable[[], Request], rate_hz: float, seconds: float, rng: np.random.Generator
) -> list[Answered]:
    """Ask at random times, ``rate_hz`` a second on average; gives back when all are answered."""
    address = urlsplit(url)
    idle: queue.SimpleQueue[http.client.HTTPConnection] = queue.SimpleQueue()
    for _ in range(_THREADS):
        idle.put(http.client.HTTPConnection(address.hostname or "", address.port, timeout=_TIMEOUT_S))
    done: list[Answered] = []
    lock = threading.Lock()

    def one(request: Request, due: float) -> None:
        connection = idle.get()
        status, body = ask(connection, request)
        answered = Answered(request.kind, time.monotonic() - due, status)
        idle.put(connection)
        if answered.good:
            request.then(body)
        with lock:
            done.append(answered)

    with ThreadPoolExecutor(_THREADS) as pool:
        due = time.monotonic()
        under_way = []
        for gap in rng.exponential(1 / rate_hz, round(rate_hz * seconds)):
            due += gap
            request = next_request()
            time.sleep(max(0.0, due - time.monotonic()))
            under_way.append(pool.submit(one, request, due))
        wait(under_way)
    while not idle.empty():
        idle.get().close()
    for future in under_way:
        future.result()
    return done


def ask(connection: http.client.HTTPConnection, request: Request) -> tuple[int, bytes]:
    """The answer's status and body; 0 without one."""
    try:
        connection.request(request.method, request.path, request.body, dict(request.headers))
        response = connection.getresponse()
        return response.status, response.read()
    except (OSError, http.client.HTTPException):
        connection.close()  # the next request opens it again
        return 0, b""
