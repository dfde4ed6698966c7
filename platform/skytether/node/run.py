"""The node's program: keeps a link to each orchestrator, and ways from there to this machine's engine; renews.

It connects to the engine's socket and to its orchestrators, and to nobody else, whoever asks for it.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import random
import resource
import ssl
import time
from asyncio import sslproto
from collections.abc import Callable, Collection, Coroutine, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any

from pydantic import ValidationError

from skytether.api.manifest import Strict
from skytether.api.node import (
    ANSWER_S,
    GO,
    MOST_LINE,
    MOST_WAYS,
    SERVER_NAME,
    SILENT_S,
    Issued,
    Link,
    Linked,
    Machine,
    Renew,
    Said,
    Told,
    Way,
    line_of,
)
from skytether.api.printable import printable
from skytether.api.splice import PIECE, Stream, closed, keep_alive, splice

from . import calls
from .calls import RefusedError, address_of, explained, read_answer, trusting
from .engine_gate import EngineGate
from .machine import ask_engine, describe, own_address
from .names import Names
from .store import NodeError, NodeStore, new_key, renew_due, request_for

log = logging.getLogger(__name__)

LOOK_S, LOOK_AWAY_S = 5.0, 1.0
"""Between two looks at the engine, and whether the certificate is to be renewed; and while the engine is away."""
AGAIN_S, _AGAIN_MOST_S = 1.0, 30.0
"""Before another attempt to link; the wait doubles, and is by chance up to a third shorter, so that a thousand nodes of
an orchestrator that was restarted do not come at once."""
_REFUSED_S = 300.0
"""Before another attempt where the last one was refused for good."""
_RENEW_AGAIN_S = 60.0
_MOST_URLS = 16
"""Orchestrators that are linked with, whatever one of them says."""
_FILES = 65_536
"""Open at a time, as far as the system lets us: each way takes two."""


@dataclass
class _Clock:
    """The orchestrator's time, as it was told, by a clock that nobody sets."""

    told: float
    at: float

    def __call__(self) -> float:
        return self.told + time.monotonic() - self.at


class NodeProgram:
    """Runs until it is cancelled, or the machine has left."""

    def __init__(self, store: NodeStore, on_linked: Callable[[str], object] = lambda _: None) -> None:
        """``on_linked`` is called with the address of each orchestrator whenever a link stands.

        Raises:
            NodeError: This machine has not joined.
        """
        self._store = store
        self._config = store.config()
        self._authority = store.authority()
        self._trust: ssl.SSLContext = trusting(self._authority, store.identity)
        config = self._config
        self._gate = None if config.unfiltered else EngineGate(config.engine, config.devices, config.registries, store)
        self._on_linked = on_linked
        self._links: dict[str, asyncio.Task[None]] = {}
        self._linked: set[str] = set()
        self._names = Names(_MOST_URLS)
        self._told: dict[str, str] = {}
        self._renewed_at = -_RENEW_AGAIN_S
        self._renewing = asyncio.Lock()
        self._doubts: set[asyncio.Event] = set()
        """Set where the engine did not answer somebody: whoever looks at it now and then looks at once."""

    async def run(self) -> None:
        """Keep all links; returns when it is cancelled, or the machine is no site of theirs any more."""
        _allow_connections()
        sslproto.SSLProtocol.max_size = PIECE  # of each connection's buffer: by itself a thousand ways take 256 MiB
        try:
            async with asyncio.TaskGroup() as group:
                self._group = group
                self._learn(self._config.urls)
                back = group.create_task(self._gate.look_back()) if self._gate else None
                while self._is_joined():
                    await asyncio.sleep(LOOK_S)
                for task in (*self._links.values(), *([back] if back else [])):
                    task.cancel()
            log.info("this machine is no site any more")
        finally:
            self._names.close()
            await closed()

    def _is_joined(self) -> bool:
        """Whoever has left does not ask who may be linked still."""
        try:
            return self._store.exists() and self._store.authority() == self._authority
        except NodeError:
            return False

    def _learn(self, urls: tuple[str, ...]) -> None:
        """Link with those that are new, and keep them."""
        for url in urls:
            if url in self._links:
                continue
            if len(self._links) >= _MOST_URLS:
                self._forget_one((self._config.urls[0], *self._linked, *urls))
            if len(self._links) < _MOST_URLS:
                with contextlib.suppress(NodeError):
                    address_of(url)
                    self._links[url] = self._group.create_task(self._keep(url))
        if (known := tuple(self._links)) != self._config.urls:
            self._config = self._config.model_copy(update={"urls": known})
            with contextlib.suppress(OSError):  # it is told again
                self._store.save(self._config)

    def _forget_one(self, but: Collection[str]) -> None:
        """One that is not linked, and of which nobody says any more that it is there; never by which it joined."""
        for url in self._links:
            if url not in but:
                self._links.pop(url).cancel()
                return

    async def _keep(self, url: str) -> None:
        wait = AGAIN_S
        while True:
            began = time.monotonic()
            try:
                await self._link(url)
                self._warn_once(url, f"the link to {url} ended")
                pause = AGAIN_S
            except RefusedError as error:
                self._warn_once(url, f"{url}: {error}")
                pause = _REFUSED_S if error.final else wait
            except NodeError as error:
                self._warn_once(url, str(error))
                pause = wait
            except Exception:  # whatever one of them says ends no other's link
                log.exception("the link to %s ended", printable(url, lines=False))
                pause = _AGAIN_MOST_S
            wait = AGAIN_S if time.monotonic() - began > _AGAIN_MOST_S else min(_AGAIN_MOST_S, 2 * wait)
            await asyncio.sleep(pause * random.uniform(2 / 3, 1))

    def _warn_once(self, url: str, text: str) -> None:
        """Once, however often it is so."""
        if self._told.get(url) != text:
            self._told[url] = text
            log.warning("%s", printable(text, lines=False))

    # One link

    async def _find(self, url: str) -> list[str]:
        try:
            async with asyncio.timeout(ANSWER_S):
                return await self._names.find(address_of(url)[0])
        except OSError as error:
            raise explained(url, error) from error

    async def _open(self, url: str, addresses: Iterable[str], request: Strict) -> Stream:
        port, writer = address_of(url)[1], None
        try:
            async with asyncio.timeout(ANSWER_S):
                reader, writer = await _connected(addresses, port)
                keep_alive(writer.get_extra_info("socket"))
                await writer.start_tls(self._trust, server_hostname=SERVER_NAME)
        except BaseException as error:
            if writer is not None:
                writer.transport.abort()
            if isinstance(error, OSError):
                raise explained(url, error) from error
            raise
        writer.write(line_of(request))
        return reader, writer

    async def _link(self, url: str) -> None:
        machine = await asyncio.to_thread(self._describe)
        found = await self._find(url)
        address = own_address(found[0], address_of(url)[1]) if self._config.follow else None
        reader, writer = await self._open(url, found, Link(machine=machine, address=address))
        try:
            async with asyncio.timeout(ANSWER_S):
                line = await reader.readuntil(b"\n")
            try:
                linked = read_answer(line, Linked, url)
            except RefusedError as error:
                if error.over:
                    await self._renew(url)
                    return
                raise
            self._told.pop(url, None)
            log.info("linked with %s", url)
            self._on_linked(url)
            self._linked.add(url)
            self._learn(linked.urls)
            there = str(writer.get_extra_info("peername")[0])
            passes = self._gate.of_link() if self._gate else None
            ways = partial(self._way, url, there, writer, linked.link, passes)
            await self._both(self._receive(reader, writer, ways), self._monitor(url, writer, linked))
        except (OSError, asyncio.IncompleteReadError, asyncio.LimitOverrunError, ValidationError) as error:
            raise NodeError(f"the link to {url} ended: {str(error) or type(error).__name__}") from error
        finally:
            self._linked.discard(url)
            writer.transport.abort()

    async def _both(self, *works: Coroutine[Any, Any, None]) -> None:
        """Until one of them ends; raises what that raised."""
        tasks = [asyncio.create_task(work) for work in works]
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    def _describe(self) -> Machine:
        try:
            engine = ask_engine(self._config.engine)
        except (OSError, ValueError):
            engine = None
        return describe(engine, self._config.echo)

    async def _receive(
        self,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
        open_way: Callable[[], Coroutine[Any, Any, None]],
    ) -> None:
        """Do what the orchestrator says until it says nothing more."""
        ways: set[asyncio.Task[None]] = set()
        try:
            while True:
                async with asyncio.timeout(SILENT_S):
                    line = await reader.readuntil(b"\n")
                told = Told.model_validate_json(line)
                if told.ping is not None:
                    writer.write(line_of(Said(pong=told.ping)))
                for _ in range(min(told.open or 0, MOST_WAYS - len(ways))):
                    way = asyncio.create_task(open_way())
                    ways.add(way)
                    way.add_done_callback(ways.discard)
                async with asyncio.timeout(SILENT_S):  # whoever asks, and takes no answer, is not heard on
                    await writer.drain()
        except asyncio.IncompleteReadError:
            return
        finally:
            for way in ways:
                way.cancel()
            await asyncio.gather(*ways, return_exceptions=True)

    async def _monitor(self, url: str, writer: asyncio.StreamWriter, linked: Linked) -> None:
        """Say when the engine goes and comes, and renew the certificate in time."""
        clock, doubt = _Clock(linked.time, time.monotonic()), asyncio.Event()
        self._doubts.add(doubt)
        try:
            await self._poll(url, writer, clock, doubt)
        finally:
            self._doubts.discard(doubt)

    async def _poll(self, url: str, writer: asyncio.StreamWriter, clock: _Clock, doubt: asyncio.Event) -> None:
        away: str | None = None
        while True:
            doubt.clear()
            now = await self._engine_away()
            if now != away:
                away = now
                writer.write(line_of(Said(engine=now[:300])))
                if now:
                    log.warning("the engine at %s cannot be reached: %s", self._config.engine, now)
            certificate = self._store.certificate()
            begins, ends = certificate.not_valid_before_utc.timestamp(), certificate.not_valid_after_utc.timestamp()
            if renew_due(begins, ends, clock()):
                with contextlib.suppress(NodeError):  # it is good still, and tried again
                    await self._renew(url)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(LOOK_AWAY_S if away else LOOK_S):
                    await doubt.wait()

    async def _engine_away(self) -> str:
        try:
            async with asyncio.timeout(ANSWER_S):
                _, writer = await asyncio.open_unix_connection(self._config.engine)
        except OSError as error:
            return error.strerror or type(error).__name__
        writer.close()
        return ""

    async def _renew(self, url: str) -> None:
        """Be known by another key from the next connection on."""
        async with self._renewing:
            if time.monotonic() - self._renewed_at < _RENEW_AGAIN_S:
                return
            self._renewed_at = time.monotonic()
            key = new_key()
            request = Renew(request=request_for(key))
            try:
                issued = await asyncio.to_thread(calls.call, url, self._trust, request, Issued)
                await asyncio.to_thread(self._store.renew, key, issued.certificate)
                self._trust = trusting(self._store.authority(), self._store.identity)
            except NodeError as error:
                log.warning("the certificate could not be renewed: %s", error)
                raise
            except OSError as error:
                raise NodeError(f"the renewed certificate cannot be kept in {self._store.folder}: {error}") from error
            log.info("the certificate was renewed")

    # Ways

    async def _way(
        self,
        url: str,
        there: str,
        told: asyncio.StreamWriter,
        link: str,
        passes: Callable[[Stream, Stream], Coroutine[Any, Any, None]] | None,
    ) -> None:
        """One connection for somebody who asks the engine from there."""
        try:
            reader, writer = await self._open(url, (there,), Way(link=link))
        except NodeError:
            told.write(line_of(Said(failed=1)))
            return
        try:
            if await reader.readexactly(1) != GO:
                return  # a refusal
            try:
                engine = await asyncio.open_unix_connection(self._config.engine, limit=PIECE)
            except OSError:
                for doubt in self._doubts:
                    doubt.set()
                raise
            try:
                await splice((reader, writer), engine, there=passes)
            finally:
                engine[1].transport.abort()
        except (OSError, asyncio.IncompleteReadError):
            pass  # whoever asked sees the connection end
        finally:
            writer.transport.abort()


async def _connected(addresses: Iterable[str], port: int) -> Stream:
    """With the first of them that answers."""
    failed = OSError("it has no address")
    for address in addresses:
        try:
            return await asyncio.open_connection(address, port, limit=MOST_LINE)
        except OSError as error:
            failed = error
    raise failed


def _allow_connections() -> None:
    """As many as the system lets this program have; a unit says that itself, and lets it change nothing."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    enough = _FILES if hard == resource.RLIM_INFINITY else min(_FILES, hard)
    if resource.RLIM_INFINITY != soft < enough:
        with contextlib.suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (enough, hard))
