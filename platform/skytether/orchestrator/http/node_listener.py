"""Where nodes connect: TLS by an authority of their own, one request a connection, in a thread and loop of its own.

Nobody gets far without a certificate: a stranger has a few seconds for his handshake and one short line, of strangers
there are so many at a time, and of more the oldest of the address that has most of them gives way.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import secrets
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from types import TracebackType
from typing import Any

from cryptography import x509

from skytether.api.manifest import Strict
from skytether.api.node import (
    ALPN,
    ANSWER_S,
    MOST_LINE,
    Hello,
    Invited,
    Join,
    Leave,
    Link,
    Linked,
    Look,
    Refused,
    Renew,
    Request,
    Standing,
    Stands,
    Way,
    Welcome,
    line_of,
    read_request,
)
from skytether.api.splice import close, closed, keep_alive

from ..config.settings import ServerLimits
from ..domain.errors import DomainError, ForbiddenError, TooManyError, UnauthenticatedError
from ..domain.rate_limit import RateLimiter
from ..nodes.authority import LiveContext, name_in, serial_of
from ..nodes.enrolment import Enrolment, Known, RemovedError
from ..nodes.ways import LinkedNode, Ways
from ..store.engine import GONE
from ..telemetry.logs import AUDIT
from .connections import Connection, ConnectionTable, forget_frames, place_of
from .node_echo import EchoLooks

log = logging.getLogger(__name__)
audit = logging.getLogger(AUDIT)
strangers = logging.getLogger("skytether.strangers")

_MOST, STRANGERS = 8192, 128
"""Connections in all, and those that have shown no certificate."""
_LOOK_S = 2.0
"""Between two looks which nodes are sites still."""
_GRACE_S = 30.0
"""From when a site is gone until the link of its node is cut: what runs there is removed by way of it."""
_GUESSES_PER_S, _GUESSES = 0.2, 10
"""Join tokens that one address may try, and at once."""
_REQUESTS_PER_S, _REQUESTS = 10.0, 60
"""Requests of one node, ways not counted, and at once."""
_LINKS_PER_S, LINKS = 0.5, 20
"""Of these, links and renewals, which change the database: one that is cut off again and again comes no more often."""
_AT_ONCE_S = 0.002
"""Seconds between two connections that are taken: a handshake costs a millisecond, and robots' requests are served by
the same process."""
_AT_ONCE = 4
"""Requests of one node under way, its links and ways not counted."""


class _NodeConnection(Connection):
    host = ""
    """Whose connection it is; ``address`` is what of it counts as one."""


class NodeListener:
    """Serves nodes until `close`."""

    def __init__(
        self,
        listener: socket.socket,
        context: LiveContext,
        enrolment: Enrolment,
        ways: Ways,
        standing: Callable[[str], Stands],
        echo: Callable[[str], tuple[str, int] | None],
        leave: Callable[[str, bool], Stands],
        clock: Callable[[], float],
    ) -> None:
        """Nothing is served before `start`.

        Args:
            listener: Listens.
            context: Our end of TLS.
            enrolment: Knows nodes and tokens.
            ways: To their engines.
            standing: How a site is now.
            echo: Where its machine says that its echo is.
            leave: Ends a site, at once or when nothing runs there; says how far that is.
            clock: Seconds since the epoch.
        """
        self._listener = listener
        self._context = context
        self._enrolment = enrolment
        self._ways = ways
        self._standing = standing
        self._echoes = EchoLooks(echo)
        self._leave = leave
        self._clock = clock
        self._table = ConnectionTable(ServerLimits(strangers=STRANGERS, connections_per_address=_MOST), _MOST)
        self._guesses = RateLimiter(_GUESSES_PER_S, _GUESSES, time.monotonic)
        self._requests = RateLimiter(_REQUESTS_PER_S, _REQUESTS, time.monotonic)
        self._links = RateLimiter(_LINKS_PER_S, LINKS, time.monotonic)
        self._told = RateLimiter(0.2, 20, time.monotonic)
        self._busy: Counter[str] = Counter()
        self._tasks: set[asyncio.Task[None]] = set()
        self._gone: dict[str, float] = {}
        self._loop = asyncio.new_event_loop()
        self._ready = threading.Event()
        self._thread = threading.Thread(target=self._run, name="nodes", daemon=True)
        self._main: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Begin to serve."""
        self._thread.start()
        self._ready.wait()

    def close(self) -> None:
        """End all connections; returns when nothing is served any more."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._stop)
            self._thread.join()

    def __enter__(self) -> NodeListener:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def cut(self, name: str) -> None:
        """A site is no more: end its node's link. From any thread."""
        with contextlib.suppress(RuntimeError):  # it is closed
            self._loop.call_soon_threadsafe(self._ways.cut, name, "its site was removed")

    def _stop(self) -> None:
        if self._main is not None:
            self._main.cancel()

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        self._main = self._loop.create_task(self._serve_all())
        self._ready.set()
        try:
            with contextlib.suppress(asyncio.CancelledError):
                self._loop.run_until_complete(self._main)
            self._loop.run_until_complete(self._end_all())
        finally:
            self._loop.run_until_complete(self._loop.shutdown_default_executor())
            self._loop.close()

    async def _end_all(self) -> None:
        await self._ways.close()
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await closed()
        others = asyncio.all_tasks() - {asyncio.current_task()}  # asyncio's own, for who was just taken
        for other in others:
            other.cancel()
        await asyncio.gather(*others, return_exceptions=True)
        await closed()

    async def _serve_all(self) -> None:
        self._listener.setblocking(False)
        async with asyncio.TaskGroup() as group:
            group.create_task(self._accept())
            group.create_task(self._sweep())
            group.create_task(self._cut_removed())

    async def _accept(self) -> None:
        while True:
            try:
                taken, peer = self._listener.accept()
            except BlockingIOError:
                await self._somebody()
                continue
            except OSError as error:  # no file for another one
                log.warning("a node's connection cannot be taken: %s", error.strerror)
                gives_way = self._table.stranger()
                if gives_way is not None:
                    self._end(gives_way)
                await asyncio.sleep(0.1)
                continue
            self._admit(taken, str(peer[0]))
            await asyncio.sleep(_AT_ONCE_S)

    async def _somebody(self) -> None:
        """Until somebody connects: `sock_accept` would lose the connection that comes while it is cancelled."""
        came = asyncio.Event()
        self._loop.add_reader(self._listener, came.set)
        try:
            await came.wait()
        finally:
            self._loop.remove_reader(self._listener)

    def _admit(self, taken: socket.socket, host: str) -> None:
        address = place_of(host)
        with contextlib.suppress(OSError):  # it is gone already
            keep_alive(taken)
        has_room, gives_way = self._table.room(address)
        if gives_way is not None:
            self._end(gives_way)
        if not has_room:
            taken.close()
            return
        connection = _NodeConnection(address, self._loop.time() + ANSWER_S, self._know)
        connection.host = host
        connection.socket = taken
        self._table.come(connection)
        task = self._loop.create_task(self._greet(taken, connection))
        self._tasks.add(task)

        def over(done: asyncio.Task[None]) -> None:
            self._tasks.discard(done)
            if connection.socket is taken:  # it was cancelled before it began
                taken.close()

        task.add_done_callback(over)

    def _know(self, connection: Connection, owner: str) -> None:
        self._table.know(connection, owner)

    def _end(self, connection: Connection) -> None:
        self._table.leave(connection)
        connection.end()

    async def _sweep(self) -> None:
        while True:
            for connection in self._table.late(self._loop.time()):
                self._end(connection)
            await asyncio.sleep(0.5)

    async def _cut_removed(self) -> None:
        """Cut those off that are no sites any more, by way of whichever orchestrator they were removed."""
        while True:
            linked = self._ways.linked()
            try:
                gone = await asyncio.to_thread(self._enrolment.still_linked, linked) if linked else set()
            except GONE:
                gone = set()
            now = self._loop.time()
            self._gone = {name: self._gone.get(name, now) for name in gone}
            for name, since in self._gone.items():
                if now - since >= _GRACE_S:
                    self._ways.cut(name, "its site was removed")
            await asyncio.sleep(_LOOK_S)

    # One connection

    async def _greet(self, taken: socket.socket, connection: _NodeConnection) -> None:
        taken.setblocking(False)
        reader = asyncio.StreamReader(limit=MOST_LINE, loop=self._loop)
        protocol = asyncio.StreamReaderProtocol(reader, loop=self._loop)
        writer: asyncio.StreamWriter | None = None
        try:
            transport, _ = await self._loop.connect_accepted_socket(
                lambda: protocol, taken, ssl=self._context.context, ssl_handshake_timeout=ANSWER_S
            )
            writer = asyncio.StreamWriter(transport, protocol, reader, self._loop)
            await self._converse(reader, writer, connection)
        except (OSError, asyncio.IncompleteReadError, asyncio.LimitOverrunError) as error:
            forget_frames(error)  # it left, was late, or speaks something else
        finally:
            self._table.leave(connection)
            connection.socket = None
            if writer is None:
                with contextlib.suppress(OSError):  # the loop has it, and closes it when it sees the end
                    taken.shutdown(socket.SHUT_RDWR)
            else:
                writer.transport.abort()

    async def _converse(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, connection: _NodeConnection
    ) -> None:
        agreed = writer.get_extra_info("ssl_object")
        if agreed.selected_alpn_protocol() != ALPN:
            return  # it wants something else
        shown = agreed.getpeercert(True)
        request: Request | None = None
        try:
            line = await reader.readuntil(b"\n")
            connection.deadline = math.inf  # it is our turn
            try:
                request = read_request(line)
            except ValueError as error:
                answer: Strict | None = Refused(error=str(error))
            else:
                answer = await self._answer(request, shown, connection, reader, writer)
        except DomainError as error:
            self._note(request, connection, str(error))
            final = not isinstance(error, TooManyError)
            answer = Refused(error=str(error)[:2000], final=final)
        except GONE:
            answer = Refused(error="the orchestrator's database does not answer: try again in a while", final=False)
        if answer is not None:
            writer.write(line_of(answer))
            async with asyncio.timeout(ANSWER_S):
                close(writer)
                await writer.wait_closed()

    async def _answer(
        self,
        request: Request,
        shown: bytes | None,
        connection: _NodeConnection,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
    ) -> Strict | None:
        """What is said to a request; None: nothing, the connection was for something else."""
        match request:
            case Hello():
                return Welcome(time=self._clock(), authority=self._context.authority)
            case Look() | Join():
                return await self._let_join(request, connection)
        if shown is None:
            raise UnauthenticatedError("this takes the certificate of a node that joined")
        certificate = x509.load_der_x509_certificate(shown)
        name = name_in(certificate)
        if isinstance(request, Way):
            await self._bring(request, name, certificate, connection, (reader, writer))
            return None
        self._spend(request, name)
        with self._one_of(name):
            answer = await self._answer_node(request, name, certificate, connection, writer)
        if not isinstance(answer, LinkedNode):
            return answer
        why = "the orchestrator ended the link"
        try:
            why = await self._ways.serve(answer, reader)
        finally:
            self._ways.end(answer, why)
        return None

    def _spend(self, request: Request, name: str) -> None:
        """Take a request of what a node may ask."""
        wait = self._requests.wait(name)
        if isinstance(request, Link | Renew):
            wait = max(wait, self._links.wait(name))
        if wait:
            raise TooManyError(wait)

    async def _answer_node(
        self,
        request: Leave | Link | Renew | Standing,
        name: str,
        certificate: x509.Certificate,
        connection: _NodeConnection,
        writer: asyncio.StreamWriter,
    ) -> Strict | LinkedNode:
        """What is said to a node that joined; or its link, which has begun."""
        try:
            known = await asyncio.to_thread(self._enrolment.admit, certificate)
        except RemovedError:
            if not isinstance(request, Leave | Standing):
                raise
            if self._ways.get(name) is None:
                return Stands(state="gone")
            return Stands(state="blocked", reason="what is left here is being removed", draining=True)
        connection.know(f"node:{name}")
        if isinstance(request, Renew):
            issued = await asyncio.to_thread(self._enrolment.renew, known, request.request)
            self._note(request, connection, "", name)
            return issued
        if known.ended:
            text = "this certificate is over: it may be renewed, and nothing else"
            return Refused(error=text, final=False, over=True)
        if isinstance(request, Standing):
            stands = await asyncio.to_thread(self._standing, name)
            echo = None if stands.state == "gone" else await self._echoes.answers(name)
            return stands.model_copy(update={"seen_as": connection.host, "echo": echo})
        if isinstance(request, Leave):
            stands = await asyncio.to_thread(self._leave, name, request.force)
            self._note(request, connection, "", name)
            return stands
        return await self._link(request, known, connection, writer)

    @contextlib.contextmanager
    def _one_of(self, name: str) -> Iterator[None]:
        """Around what a node asks for that takes a thread: no node takes all of them."""
        if self._busy[name] >= _AT_ONCE:
            raise TooManyError(1.0, f"{_AT_ONCE} requests of node '{name}' are under way: wait for their answers")
        self._busy[name] += 1
        try:
            yield
        finally:
            self._busy[name] -= 1
            if not self._busy[name]:
                del self._busy[name]

    async def _let_join(self, request: Look | Join, connection: _NodeConnection) -> Strict:
        if wait := self._guesses.empty(connection.address):
            raise TooManyError(wait)
        try:
            if isinstance(request, Look):
                invitation = await asyncio.to_thread(self._enrolment.check_token, request.token)
                site = invitation.site
                urls = self._enrolment.urls
                return Invited(name=site.name, tier=site.tier, ends_at=invitation.expires_at, urls=urls)
            node, issued = await asyncio.to_thread(self._enrolment.join, request, connection.host)
        except UnauthenticatedError:
            self._guesses.wait(connection.address)
            raise
        self._note(request, connection, "", node.site)
        return issued

    async def _link(
        self, request: Link, known: Known, connection: _NodeConnection, writer: asyncio.StreamWriter
    ) -> LinkedNode | Refused:
        """Begin a node's link, unless one is alive: another machine's, or of a program with a copy of its key."""
        name, machine = known.name, request.machine
        there = self._ways.get(name)
        if there is not None and await self._ways.is_alive(name):
            who = "another machine is" if there.machine != machine.id else "this machine, or one that says so, is"
            return Refused(
                error=f"{who} linked as '{name}', from {there.seen_as}: this one is a copy of it; run "
                "`skytether site leave --force` on the one that is to be no site, and invite it under another name",
                final=False,
            )
        await asyncio.to_thread(self._enrolment.linked, known, machine, request.address, connection.host)
        now = asyncio.get_running_loop().time()
        node = LinkedNode(name, known.node.serial, machine.id, connection.host, writer, heard_at=now)
        writer.write(
            line_of(
                Linked(
                    time=self._clock(),
                    begins=known.begins_at,
                    ends=known.node.ends_at,
                    link=node.secret,
                    urls=self._enrolment.urls,
                )
            )
        )
        self._ways.begin(node)
        return node

    async def _bring(
        self,
        request: Way,
        name: str,
        certificate: x509.Certificate,
        connection: _NodeConnection,
        stream: tuple[asyncio.StreamReader, asyncio.StreamWriter],
    ) -> None:
        """A way to the engine of the node whose certificate it is, and of no other."""
        node = self._ways.get(name)
        if node is None:
            raise ForbiddenError("a node has ways while its link stands, and this one's does not")
        if not secrets.compare_digest(request.link.encode(), node.secret.encode()):
            raise ForbiddenError("this way is of no link that stands: whoever opens it is not at the other end")
        if serial_of(certificate) != node.serial:
            with self._one_of(name):
                await asyncio.to_thread(self._enrolment.admit, certificate)
            node.serial = serial_of(certificate)  # it was renewed
        connection.know(f"node:{name}")
        if not await self._ways.bring(node, stream):
            raise ForbiddenError("nobody asked for this way")

    def _note(self, request: Request | None, connection: _NodeConnection, refused: str, name: str = "") -> None:
        """In the audit what somebody did whom we know; strangers are told of elsewhere, a few of them."""
        if request is None or isinstance(request, Way):
            return
        fields: dict[str, Any] = {
            "who": f"node:{name}" if name else "nobody",
            "address": connection.host,
            "method": request.do.upper(),
            "path": f"/nodes/{name}" if name else "/nodes",
            "status": 403 if refused else 200,
        }
        if refused:
            fields["refused"] = refused[:200]
            if self._told.wait("all"):
                return
        text = " ".join(str(value) for value in fields.values())
        (audit if name else strangers).info("%s", text, extra={"fields": fields})
