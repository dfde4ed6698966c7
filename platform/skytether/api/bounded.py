"""HTTP answers that end: none is larger, and none takes longer, than who asked can bear.

A robot asks an orchestrator that somebody else runs. httpx bounds each read, but neither their number nor their sum: an
answer of gigabytes, headers that dribble in and interim answers without end would take the robot's memory, or its
thread for good. Below httpx there is one place where all bytes come by: the stream of the connection.
"""

from __future__ import annotations

import ssl
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from math import inf
from typing import Any, cast

import httpcore
import httpx

_CONNECTIONS, _KEPT_S = 100, 5.0
"""As httpx has it: at the same time, and how long one is kept that nobody uses [s]."""
WHOLE = "whole_s"
"""Extension of a request: by when all of its answer is there [s]; without it an answer may go on for ever."""


class EndlessError(httpx.TransportError):
    """An answer is larger than anybody asked for, or comes packed, so that nobody knows how large it is."""


class BoundedTransport(httpx.HTTPTransport):
    """Answers of requests with the extension `WHOLE` are whole by then, and at most ``largest`` bytes.

    Args:
        verify: Of the certificate; None: there is none.
        largest: Bytes of a body, but of a stream.
        clock: Monotonic seconds.
    """

    def __init__(
        self, verify: ssl.SSLContext | None, largest: int, clock: Callable[[], float] = time.monotonic
    ) -> None:
        super().__init__(verify=verify or False, trust_env=False)
        self._largest = largest
        self._clock = clock
        self._until = _Until(clock)
        self._pool = httpcore.ConnectionPool(
            ssl_context=verify,
            max_connections=_CONNECTIONS,
            keepalive_expiry=_KEPT_S,
            network_backend=_Backend(self._until),
        )

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        """One exchange, up to the end of the answer's headers."""
        end = self._clock() + request.extensions.get(WHOLE, inf)
        with self._until.the(end):
            response = super().handle_request(request)
        if response.headers.get("content-encoding", "identity") != "identity":
            response.close()
            raise EndlessError("an answer came packed, which was not asked for")
        bounded = WHOLE in request.extensions or response.is_error
        body = cast("httpx.SyncByteStream", response.stream)
        response.stream = _Body(body, self._largest if bounded else inf, lambda: self._until.the(end))
        return response


class _Until(threading.local):
    """By when the answer that a thread reads must be there."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._at = inf

    @contextmanager
    def the(self, at: float) -> Iterator[None]:
        """Within it, that is the time [monotonic s]."""
        before, self._at = self._at, at
        try:
            yield
        finally:
            self._at = before

    def patience(self, timeout: float | None) -> float | None:
        """How long one read may take.

        Raises:
            httpcore.ReadTimeout: It is later than that.
        """
        left = self._at - self._clock()
        if left <= 0:
            raise httpcore.ReadTimeout("the answer does not end")
        return timeout if left == inf else min(left, left if timeout is None else timeout)


class _Body(httpx.SyncByteStream):
    def __init__(self, stream: httpx.SyncByteStream, most: float, within: Callable[[], Any]) -> None:
        self._stream = stream
        self._most = most
        self._within = within

    def __iter__(self) -> Iterator[bytes]:
        parts, length = iter(self._stream), 0
        while True:
            with self._within():
                part = next(parts, None)
            if part is None:
                return
            length += len(part)
            if length > self._most:
                raise EndlessError(f"an answer is larger than {self._most} bytes")
            yield part

    def close(self) -> None:
        self._stream.close()


class _Backend(httpcore.SyncBackend):
    def __init__(self, until: _Until) -> None:
        self._until = until

    def connect_tcp(
        self,
        host: str,
        port: int,
        timeout: float | None = None,
        local_address: str | None = None,
        socket_options: Iterable[Any] | None = None,
    ) -> httpcore.NetworkStream:
        made = super().connect_tcp(host, port, timeout, local_address, socket_options)
        return _Stream(made, self._until)


class _Stream(httpcore.NetworkStream):
    def __init__(self, stream: httpcore.NetworkStream, until: _Until) -> None:
        self._stream = stream
        self._until = until

    def read(self, max_bytes: int, timeout: float | None = None) -> bytes:
        return self._stream.read(max_bytes, self._until.patience(timeout))

    def write(self, buffer: bytes, timeout: float | None = None) -> None:
        self._stream.write(buffer, timeout)

    def close(self) -> None:
        self._stream.close()

    def start_tls(
        self, ssl_context: ssl.SSLContext, server_hostname: str | None = None, timeout: float | None = None
    ) -> httpcore.NetworkStream:
        return _Stream(self._stream.start_tls(ssl_context, server_hostname, timeout), self._until)

    def get_extra_info(self, info: str) -> Any:
        return self._stream.get_extra_info(info)
