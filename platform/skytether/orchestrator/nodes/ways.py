"""The ways to the engines of linked nodes: for each node a socket in its site's folder, and what is spliced to it.

Whoever connects to the socket gets a connection that the node has opened and that waits for it, or, if none waits, one
that the node is asked to open. All of it runs in the loop of the door for nodes.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import secrets
import socket
import time
from collections import deque
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

from skytether.api.node import ANSWER_S, GO, MOST_WAYS, PING_S, SILENT_S, Said, Told, line_of
from skytether.api.splice import PIECE, Stream, close, splice

from ..domain.rate_limit import RateLimiter
from ..runtimes.base import ENGINE_AWAY, ENGINE_SOCKET

log = logging.getLogger(__name__)

SPARE = 4
"""Ways that wait, so that who asks does not wait for a handshake."""
_MOST_WAITING = 256
"""Who waits for a way of one node at a time; of more, each is refused."""
_BACKLOG = 128
_LINES_PER_S, _LINES = 50.0, 2 * MOST_WAYS
"""What a node may say on its link, and at once: all its ways fail at once where its machine has no room for them."""
_TURNS_PER_S, _TURNS = 0.5, 10
"""Of these, those by which its engine goes or comes: with each the socket here goes or comes."""
BYTES_PER_S, BYTES = 8 << 20, 32 << 20
"""What its engine may say, and at once: a thousand containers tell 3 MiB a second, and all is read in one process,
where robots' requests are served, too. Beyond that it waits, and so does nobody else."""
MOST_UNREAD = 1 << 16
"""Bytes that a node has not taken of what it was told on its link, some thousand lines."""


@dataclass(eq=False)
class LinkedNode:
    """A node whose link stands."""

    name: str
    serial: str
    """Of the certificate by which the link is."""
    machine: str
    """Which machine it is."""
    seen_as: str
    writer: asyncio.StreamWriter
    heard_at: float
    """When it said something last, by the loop's clock."""
    secret: str = field(default_factory=lambda: secrets.token_hex(16), repr=False)
    """Known to whoever is at the other end of the link: whose ways these are."""
    engine_away: str | None = None
    """Why its engine cannot be reached; empty: it can; None: it has not said yet."""
    spare: deque[tuple[Stream, asyncio.Future[None]]] = field(default_factory=deque)
    """Ways that wait, each with what ends its connection when it is done."""
    waiting: deque[asyncio.Future[tuple[Stream, asyncio.Future[None]]]] = field(default_factory=deque)
    wanted: int = 0
    """Ways that it was asked for and has not opened."""
    open: int = 0
    """Ways that it has open, those that wait included."""
    listener: socket.socket | None = None
    tasks: set[asyncio.Task[None]] = field(default_factory=set)

    def send(self, told: Told) -> None:
        """Without waiting: who does not read for long is cut off by its silence."""
        self.writer.write(line_of(told))


class Ways:
    """All linked nodes. Called in the loop only."""

    def __init__(self, folder: Path) -> None:
        """``folder`` has a folder for each site."""
        self._folder = folder
        self._nodes: dict[str, LinkedNode] = {}
        self._all: set[asyncio.Task[None]] = set()
        """Of all nodes, also of links that have ended."""
        self._lines = RateLimiter(_LINES_PER_S, _LINES, time.monotonic)
        self._turns = RateLimiter(_TURNS_PER_S, _TURNS, time.monotonic)
        self._bytes = RateLimiter(BYTES_PER_S, BYTES, time.monotonic)

    def linked(self) -> dict[str, str]:
        """Those that are, each with the address that it is seen as."""
        return {name: node.seen_as for name, node in self._nodes.items()}

    def get(self, name: str) -> LinkedNode | None:
        return self._nodes.get(name)

    # Links

    async def is_alive(self, name: str) -> bool:
        """Whether the link that a node has says something when it is asked; a moment is waited for it."""
        node = self._nodes.get(name)
        if node is None:
            return False
        before = node.heard_at
        node.send(Told(ping=0))
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(PING_S / 2):
                while self._nodes.get(name) is node and node.heard_at == before:
                    await asyncio.sleep(0.02)
        return self._nodes.get(name) is node and node.heard_at != before

    def begin(self, node: LinkedNode) -> None:
        """A link stands; one that the node had before is cut."""
        self.cut(node.name, "it was linked anew")
        self._nodes[node.name] = node
        log.info("node %s is linked from %s", node.name, node.seen_as)

    async def serve(self, node: LinkedNode, reader: asyncio.StreamReader) -> str:
        """Hear what a node says until its link ends; why it did."""
        pinging = asyncio.create_task(self._ping(node))
        try:
            while True:
                try:
                    async with asyncio.timeout(SILENT_S):
                        line = await reader.readuntil(b"\n")
                except TimeoutError:
                    return f"it said nothing for {SILENT_S:.0f} s"
                node.heard_at = asyncio.get_running_loop().time()
                said = Said.model_validate_json(line)
                await _until_free(self._lines, node.name)
                if said.engine is not None:
                    await _until_free(self._turns, node.name)
                self._on_message(node, said)
                if node.writer.transport.get_write_buffer_size() > MOST_UNREAD:
                    return "it does not read what it is told"
        except asyncio.IncompleteReadError:
            return "the connection ended"
        except (OSError, ValueError, asyncio.LimitOverrunError) as error:
            return f"the connection failed: {str(error).splitlines()[0][:200] if str(error) else type(error).__name__}"
        finally:
            pinging.cancel()

    async def _ping(self, node: LinkedNode) -> None:
        for number in range(1, 1 << 62):
            node.send(Told(ping=number))
            await asyncio.sleep(PING_S)

    def _on_message(self, node: LinkedNode, said: Said) -> None:
        if said.engine is not None and said.engine != node.engine_away:
            node.engine_away = said.engine
            if said.engine:
                self._close_socket(node, f"the engine there cannot be reached: {said.engine}")
            else:
                self._open_socket(node)
        if said.failed:
            node.wanted = max(0, node.wanted - said.failed)
            for _ in range(min(said.failed, len(node.waiting))):
                waits = node.waiting.popleft()
                if not waits.done():
                    waits.cancel()

    def end(self, node: LinkedNode, why: str) -> None:
        """A link is over, with all that went by it."""
        if self._nodes.get(node.name) is node:
            del self._nodes[node.name]
            self._close_socket(node, f"since {datetime.now(UTC):%Y-%m-%d %H:%M:%S} UTC: {why}")
            log.warning("node %s is not linked any more: %s", node.name, why)
        for task in node.tasks:
            task.cancel()
        while node.spare:
            (_, writer), done = node.spare.popleft()
            close(writer)
            if not done.done():
                done.set_result(None)
        while node.waiting:
            node.waiting.popleft().cancel()
        node.writer.transport.abort()

    def cut(self, name: str, why: str) -> None:
        """End a node's link, if it has one."""
        node = self._nodes.get(name)
        if node is not None:
            self.end(node, why)

    async def close(self) -> None:
        """End all links, and what went by them."""
        for name in list(self._nodes):
            self.cut(name, "the orchestrator was stopped")
        await asyncio.gather(*self._all, return_exceptions=True)

    # The socket

    def _open_socket(self, node: LinkedNode) -> None:
        folder = self._folder / node.name
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        (folder / ENGINE_SOCKET).unlink(missing_ok=True)
        listener = socket.socket(socket.AF_UNIX)
        file = os.open(folder, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            # By the folder's number: the path of a state folder may be longer than a socket's may be.
            draft = f"/proc/self/fd/{file}/{ENGINE_SOCKET}.new"
            with contextlib.suppress(FileNotFoundError):
                os.unlink(draft)
            listener.bind(draft)
            os.chmod(draft, 0o600)
            listener.listen(_BACKLOG)
            os.rename(draft, f"/proc/self/fd/{file}/{ENGINE_SOCKET}")
        except OSError:
            listener.close()
            raise
        finally:
            os.close(file)

        listener.setblocking(False)
        node.listener = listener
        asyncio.get_running_loop().add_reader(listener.fileno(), self._accept, node, listener)
        (folder / ENGINE_AWAY).unlink(missing_ok=True)
        self._want(node, SPARE - len(node.spare) - node.wanted)

    def _close_socket(self, node: LinkedNode, why: str) -> None:
        listener, node.listener = node.listener, None
        folder = self._folder / node.name
        if listener is not None:
            asyncio.get_running_loop().remove_reader(listener.fileno())
            listener.close()
        with contextlib.suppress(OSError):  # the site is gone, or the disk full
            (folder / ENGINE_SOCKET).unlink(missing_ok=True)
            (folder / ENGINE_AWAY).write_text(why)

    def _accept(self, node: LinkedNode, listener: socket.socket) -> None:
        """Somebody here wants to ask a node's engine. asyncio's own servers lose whom they take as they are closed."""
        try:
            taken, _ = listener.accept()
        except OSError:
            return
        taken.setblocking(False)
        task = asyncio.get_running_loop().create_task(self._asked(node, taken))
        task.add_done_callback(lambda _: taken.close())  # also of one that was ended before it began
        for tasks in (node.tasks, self._all):
            tasks.add(task)
            task.add_done_callback(tasks.discard)

    # Ways

    def _want(self, node: LinkedNode, count: int) -> None:
        count = min(count, MOST_WAYS - node.open - node.wanted)
        if count > 0:
            node.wanted += count
            node.send(Told(open=count))

    async def bring(self, node: LinkedNode, stream: Stream) -> bool:
        """A node has opened a way: keep it until it is used up. False: nobody asked for it."""
        if node.wanted <= 0:
            return False
        node.wanted -= 1
        node.open += 1
        done: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        try:
            while node.waiting:
                waits = node.waiting.popleft()
                if not waits.done():
                    waits.set_result((stream, done))
                    break
            else:
                node.spare.append((stream, done))
            await done
        finally:
            node.open -= 1
        return True

    async def _asked(self, node: LinkedNode, taken: socket.socket) -> None:
        """Have somebody here ask a node's engine."""
        done: asyncio.Future[None] | None = None
        reader, writer = await asyncio.open_unix_connection(sock=taken, limit=PIECE)
        try:
            (theirs, them), done = await self._way(node)
            try:
                them.write(GO)
                await splice((reader, writer), (theirs, them), lambda size: self._heard(node, size))
            finally:
                them.transport.abort()
        except (OSError, TimeoutError, asyncio.CancelledError):
            pass  # whoever asked sees the connection end
        finally:
            writer.transport.abort()
            if done is not None and not done.done():
                done.set_result(None)

    async def _heard(self, node: LinkedNode, size: int) -> None:
        """Its engine has said so many bytes: wait until that is no more than it may."""
        self._bytes.charge(node.name, size)
        while wait := self._bytes.empty(node.name):
            await asyncio.sleep(wait)

    async def _way(self, node: LinkedNode) -> tuple[Stream, asyncio.Future[None]]:
        while node.spare:
            stream, done = node.spare.popleft()
            self._want(node, 1)
            if not stream[0].at_eof() and not stream[1].is_closing():
                return stream, done
            stream[1].transport.abort()
            if not done.done():
                done.set_result(None)
        if len(node.waiting) >= _MOST_WAITING or self._nodes.get(node.name) is not node:
            raise ConnectionError
        waits: asyncio.Future[tuple[Stream, asyncio.Future[None]]] = asyncio.get_running_loop().create_future()
        node.waiting.append(waits)
        self._want(node, 1)
        try:
            async with asyncio.timeout(ANSWER_S):
                return await waits
        except BaseException:
            if waits.done() and not waits.cancelled():  # it came in the very moment
                (_, writer), done = waits.result()
                writer.transport.abort()
                done.set_result(None)
            raise


async def _until_free(throttle: RateLimiter, name: str) -> None:
    """Take one of what a node may, and wait for it: meanwhile nothing of it is read, so it waits, too."""
    while wait := throttle.wait(name):
        await asyncio.sleep(wait)
