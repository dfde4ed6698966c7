"""Connections that are closed, and cut where that takes too long."""

from __future__ import annotations

import asyncio
import ssl
from pathlib import Path

import pytest
from certificates import certificate

from skytether.api.splice import close

MUCH = bytes(1 << 24)
"""More than goes on its way while nobody reads."""


@pytest.mark.parametrize("secure", [False, True], ids=["tcp", "tls"])
def test_a_connection_that_is_closing_can_still_be_cut(tmp_path: Path, secure: bool) -> None:
    """Its other side reads nothing, so that what was written before is in the way of the close."""
    asyncio.run(_closed_twice_and_cut(tmp_path, secure))


async def _closed_twice_and_cut(folder: Path, secure: bool) -> None:
    context = theirs = None
    if secure:
        paths = certificate(folder)
        context, theirs = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER), ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.load_cert_chain(*paths)
        theirs.check_hostname, theirs.verify_mode = False, ssl.CERT_NONE
    taken: asyncio.Queue[asyncio.StreamWriter] = asyncio.Queue()
    server = await asyncio.start_server(lambda _, writer: taken.put(writer), "127.0.0.1", 0, ssl=context)
    async with server:
        _, client = await asyncio.open_connection(*server.sockets[0].getsockname(), ssl=theirs, limit=1)
        writer = await taken.get()
        writer.write(MUCH)
        for _ in range(2):
            close(writer)
        writer.transport.abort()
        async with asyncio.timeout(10):
            await writer.wait_closed()
        client.transport.abort()
        await asyncio.sleep(0)
