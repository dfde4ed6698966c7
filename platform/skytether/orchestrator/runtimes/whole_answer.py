"""Answers over HTTP that are whole, head and body, within their call's time-out, though they come in drops."""

from __future__ import annotations

import io
import socket
import time
from collections.abc import Callable
from functools import partial
from http.client import HTTPResponse
from math import inf
from typing import Any

from typing_extensions import override


class WholeAnswer(HTTPResponse):
    """Head and body are there within the socket's time-out.

    Attributes:
        until: The moment, by the monotonic clock [s]; whoever reads a stream sets it to infinity.
    """

    def __init__(self, sock: Any, *arguments: Any, **options: Any) -> None:
        super().__init__(sock, *arguments, **options)
        self.until = time.monotonic() + (sock.gettimeout() or inf)
        self.fp = io.BufferedReader(_Hurried(sock, self.fp.detach(), self))


class _Hurried(io.RawIOBase):
    """What comes from a socket, up to a moment: http.client waits for each byte anew, and so without end for drops."""

    def __init__(self, sock: Any, raw: io.RawIOBase, answer: WholeAnswer) -> None:
        self._sock, self._raw, self._answer = sock, raw, answer
        self._patience = sock.gettimeout()

    @override
    def readable(self) -> bool:
        return True

    @override
    def readinto(self, buffer: Any) -> int | None:
        left = self._answer.until - time.monotonic()
        if left <= 0:
            raise TimeoutError
        if self._patience is not None and left < inf:
            self._sock.settimeout(min(left, self._patience))
        return self._raw.readinto(buffer)

    @override
    def close(self) -> None:
        self._raw.close()
        super().close()


def hurried(get: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
    """What ``get`` gives, a pool of urllib3's; its connections' answers are `WholeAnswer`."""
    pool = get(*arguments, **options)
    make = pool._new_conn  # noqa: SLF001 (pools of the SDKs have their own, and no other place for it)
    if not isinstance(make, partial):
        pool._new_conn = partial(_connection, make)  # noqa: SLF001
    return pool


def _connection(make: Callable[[], Any]) -> Any:
    made = make()
    made.response_class = WholeAnswer
    if hasattr(made, "unix_socket"):
        made.connect = partial(_connect, made)
    return made


def _connect(made: Any) -> None:
    """As Docker's SDK, which leaves a socket open that it could not connect."""
    made.sock = socket.socket(socket.AF_UNIX)
    try:
        made.sock.settimeout(made.timeout)
        made.sock.connect(made.unix_socket)
    except OSError:
        made.close()
        raise


def original(answer: Any) -> Any:
    """The `WholeAnswer` below an answer of urllib3's."""
    return answer._original_response  # noqa: SLF001
