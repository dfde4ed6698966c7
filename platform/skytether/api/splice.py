"""Two connections as one: what one says the other hears. For ways to the engines of joined nodes, at both ends."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any

from .node import ANSWER_S

PIECE = 1 << 16
_TURNS = 5
_QUIET_S = 15
"""Seconds: NATs forget TCP connections after minutes."""
_UNHEARD_S = 20
"""Seconds without a sign that what was sent has arrived, after which a connection is dead."""
Stream = tuple[asyncio.StreamReader, asyncio.StreamWriter]


async def splice(
    one: Stream,
    other: Stream,
    pace: Callable[[int], Awaitable[None]] | None = None,
    there: Callable[[Stream, Stream], Coroutine[Any, Any, None]] | None = None,
) -> None:
    """Pass bytes both ways until one side has ended, and what it said before has arrived.

    Neither end of the other side is kept then: who asks an engine over HTTP ends when it has its answer.

    Args:
        one: A connection.
        other: Another one.
        pace: Awaited with the number of bytes that ``other`` said, before more of it is read.
        there: Passes on what ``one`` says, until that ends; None: all of it, as it is.
    """
    told = there(one, other) if there else _pass(one[0], other[1])
    ways = [asyncio.create_task(told), asyncio.create_task(_pass(other[0], one[1], pace))]
    try:
        await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
        for _, writer in (one, other):
            with contextlib.suppress(OSError):
                async with asyncio.timeout(ANSWER_S):
                    close(writer)
                    await writer.wait_closed()
    finally:
        for way in ways:
            way.cancel()
        await asyncio.gather(*ways, return_exceptions=True)


def keep_alive(connection: socket.socket) -> None:
    """Have the kernel say something while nobody else does, lest a NAT on the way forgets the connection.

    Ways to an engine wait for minutes; whoever gets one that is dead would wait for an answer that never comes.
    """
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in (
        (socket.TCP_KEEPIDLE, _QUIET_S),
        (socket.TCP_KEEPINTVL, _QUIET_S // 3),
        (socket.TCP_KEEPCNT, 3),
        (socket.TCP_USER_TIMEOUT, 1000 * _UNHEARD_S),
    ):
        connection.setsockopt(socket.IPPROTO_TCP, option, value)


def close(writer: asyncio.StreamWriter) -> None:
    """Begin to close a connection, unless that is under way.

    With a second `close` a transport over TLS forgets what it is over. To abort it does nothing then, and raises with
    Python 3.11.2, which is Debian 12's.
    """
    if not writer.is_closing():
        writer.close()


async def closed() -> None:
    """Until connections that were aborted are closed, before a loop ends: each takes a turn for itself and for TLS."""
    for _ in range(_TURNS):
        await asyncio.sleep(0)


async def _pass(
    reader: asyncio.StreamReader, writer: asyncio.StreamWriter, pace: Callable[[int], Awaitable[None]] | None = None
) -> None:
    while data := await reader.read(PIECE):
        writer.write(data)
        await writer.drain()
        if pace is not None:
            await pace(len(data))
