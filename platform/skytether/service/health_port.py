"""What a service answers of its health over HTTP, where its runtime cannot look at its files (Kubernetes).

``/healthz`` says 200 while the service is ready and its loop alive, 503 and one sentence otherwise; ``/reports`` gives
what it reported (`skytether.api.service_report`), what its container uses (`skytether.api.usage`), and that sentence
once more. The cluster asks every second; nothing of it is secret.

Whoever reaches the pod may ask, however slowly and often: each has a moment in all, and of too many at once the oldest
gives way, so the cluster's own question is answered.
"""

from __future__ import annotations

import asyncio
import json
import os
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http import HTTPStatus
from pathlib import Path
from typing import Any

from skytether.api.grant import DEFAULT_GRANT_PATH, GRANT_VARIABLE, Grant
from skytether.api.service_report import FILE_NAME, MOST_BYTES
from skytether.api.splice import closed
from skytether.api.usage import write_usage

from .container_usage import container_usage
from .health import check

TIMEOUT_S = 2.0
"""Of one connection, whatever comes on it."""
_MOST_AT_ONCE = 64
_MOST_HEAD = 16 << 10
"""Bytes of a request."""


@contextmanager
def answering(grant: Grant) -> Iterator[None]:
    """Answer on the grant's ``health_port``; 0: there is none.

    Raises:
        OSError: Another program has it.
    """
    if not grant.health_port or grant.ready_file is None:
        yield
        return
    listener = socket.create_server((grant.bind_host, grant.health_port))
    answers = _Answers(Path(grant.ready_file).with_name(FILE_NAME))
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=_serve, args=(loop, listener, answers), name="health", daemon=True)
    thread.start()
    try:
        yield
    finally:
        loop.call_soon_threadsafe(loop.stop)
        thread.join()


def _serve(loop: asyncio.AbstractEventLoop, listener: socket.socket, answers: _Answers) -> None:
    server = loop.run_until_complete(asyncio.start_server(answers.connected, sock=listener, limit=_MOST_HEAD))
    loop.run_forever()
    loop.remove_reader(listener)  # asyncio leaves to the collector whom a closed server has taken and not begun with
    loop.run_until_complete(answers.end())
    server.close()
    loop.close()


class _Answers:
    def __init__(self, reports: Path) -> None:
        self._reports = reports
        self._grant = os.environ.get(GRANT_VARIABLE, DEFAULT_GRANT_PATH)
        self._open: dict[asyncio.StreamWriter, None] = {}
        """Oldest first."""
        self._ended = False

    async def connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answer one request, and close."""
        self._open[writer] = None
        if len(self._open) > _MOST_AT_ONCE:
            self._cut(next(iter(self._open)))
        if self._ended:
            self._cut(writer)
        try:
            async with asyncio.timeout(TIMEOUT_S):
                head = await reader.readuntil(b"\r\n\r\n")
                writer.write(self._answer(head))
                await writer.drain()
                writer.close()
                await writer.wait_closed()
        except (OSError, EOFError, TimeoutError, asyncio.LimitOverrunError):
            pass
        finally:
            self._cut(writer)

    async def end(self) -> None:
        """Cut all that are open, and who comes in this very moment; returns when they are closed."""
        self._ended = True
        for writer in list(self._open):
            self._cut(writer)
        while others := asyncio.all_tasks() - {asyncio.current_task()}:
            await asyncio.wait(others)
        await closed()

    def _cut(self, writer: asyncio.StreamWriter) -> None:
        if writer in self._open:
            del self._open[writer]
            writer.transport.abort()

    def _answer(self, head: bytes) -> bytes:
        status, body = HTTPStatus.NOT_FOUND, b""
        method, _, rest = head.partition(b" ")
        path = rest.partition(b" ")[0]
        if method != b"GET":
            status = HTTPStatus.METHOD_NOT_ALLOWED
        elif path == b"/healthz":
            trouble = check(self._grant, time.time())
            status, body = HTTPStatus.SERVICE_UNAVAILABLE if trouble else HTTPStatus.OK, (trouble or "alive").encode()
        elif path == b"/reports":
            trouble = check(self._grant, time.time())
            told = {**self._read(), "usage": write_usage(container_usage()), "trouble": trouble}
            status, body = HTTPStatus.OK, json.dumps(told).encode()
        return f"HTTP/1.0 {status} {status.phrase}\r\nContent-Length: {len(body)}\r\n\r\n".encode() + body

    def _read(self) -> dict[str, Any]:
        try:
            with self._reports.open("rb") as file:
                document = json.loads(file.read(MOST_BYTES))
        except (OSError, ValueError, RecursionError):
            return {}
        return document if isinstance(document, dict) else {}
