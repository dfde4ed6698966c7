"""Requests that are due whether or not those before were answered, over plain HTTP connections that are kept.

The client costs as little as it can, for it runs beside what it measures: the standard library's, one connection for
each thread.
"""

from __future__ import annotations

import http.client
import queue
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from urllib.parse import urlsplit

import numpy as np

_THREADS = 64
"""Requests under way at most; one that waits for a thread is late, and counts as such."""
_TIMEOUT_S = 30.0
_SWITCH_S = 0.0002
"""For which one of the threads computes while others wait: with Python's usual 5 ms an answer that is there already
waits for its turn to be read, and the orchestrator would be called late for it."""


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
        return is_good(self.status)


def ask_openly(
    url: str, next_request: Callable[[], Request], rate_hz: float, seconds: float, rng: np.random.Generator
) -> list[Answered]:
    """Ask at random times, ``rate_hz`` a second on average; gives back when all are answered."""
    address = urlsplit(url)
    idle: queue.SimpleQueue[http.client.HTTPConnection] = queue.SimpleQueue()
    """Used in turn, so that none is quiet for so long that it is closed."""
    for _ in range(_THREADS):
        idle.put(http.client.HTTPConnection(address.hostname or "", address.port, timeout=_TIMEOUT_S))
    due_now: queue.SimpleQueue[tuple[Request, float] | None] = queue.SimpleQueue()
    # No object for each answer until all are there: of hundreds of thousands Python's collector takes up to a second,
    # in which this client reads no answer, and would call the others late.
    kinds: list[str] = []
    took: list[float] = []
    statuses: list[int] = []
    lock = threading.Lock()

    def serve() -> None:
        while (one := due_now.get()) is not None:
            request, due = one
            connection = idle.get()
            status, body = ask(connection, request)
            seconds = time.monotonic() - due
            idle.put(connection)
            if is_good(status):
                request.then(body)
            with lock:
                kinds.append(request.kind)
                took.append(seconds)
                statuses.append(status)

    with _quick_turns(), ThreadPoolExecutor(_THREADS) as pool:
        serving = [pool.submit(serve) for _ in range(_THREADS)]
        try:
            due = time.monotonic()
            for gap in rng.exponential(1 / rate_hz, round(rate_hz * seconds)):
                due += gap
                request = next_request()
                time.sleep(max(0.0, due - time.monotonic()))
                due_now.put((request, due))
        finally:
            for _ in serving:
                due_now.put(None)
    while not idle.empty():
        idle.get().close()
    for one in serving:
        one.result()
    return [Answered(*one) for one in zip(kinds, took, statuses, strict=True)]


@contextmanager
def _quick_turns() -> Iterator[None]:
    usual = sys.getswitchinterval()
    sys.setswitchinterval(_SWITCH_S)
    try:
        yield
    finally:
        sys.setswitchinterval(usual)


def is_good(status: int) -> bool:
    """Whether an answer is one."""
    return 200 <= status < 300


def ask(connection: http.client.HTTPConnection, request: Request) -> tuple[int, bytes]:
    """The answer's status and body; 0 without one."""
    try:
        connection.request(request.method, request.path, request.body, dict(request.headers))
        response = connection.getresponse()
        return response.status, response.read()
    except (OSError, http.client.HTTPException):
        connection.close()  # the next request opens it again
        return 0, b""
