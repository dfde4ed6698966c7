"""What becomes of a request before anybody serves it: who asks, all of what they ask, and a place to be served at.

In this order, so that each step is paid by who was let through the one before: nothing is read of a body before its
sender has shown a good token, and no place is taken before all of it is there.
"""

from __future__ import annotations

import contextlib
import re
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Iterator
from functools import partial
from typing import Any, Protocol

from anyio import CapacityLimiter, to_thread
from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from ..access.access import Principal
from ..config.settings import ServerLimits
from ..domain.errors import TooManyError, UnauthenticatedError
from ..domain.overload import Overload
from .connections import CONNECTION
from .problems import answer, answer_to
from .refusal_delay import RefusalDelay

PRINCIPAL = "principal"
"""Key of who asks in the state of a request."""
RUN = "run"
"""Key of what runs a function beside the loop, in a thread for this kind of request."""
_FREE = "/healthz"
"""Costs nothing; and to take an orchestrator for dead because it has much to do would help nobody."""
_API = "/api/"
_OK, _NOT_FOUND, _BUSY = 200, 404, 503
_RENEWAL = re.compile(r"/api/v1/instances/[^/]+/renew")
_ASTRAY = re.compile(r"/(\.{0,2})(/|$)|[\x00-\x1f\x7f]")
"""What some proxies and clients take for another path than we would."""
_PROBE = re.compile(r"/api/v1/sites/[^/]+/probe")
_MOST_HELD = 64 << 20
"""Bytes of bodies, of all that have not arrived whole: as many as 64 manifests of the largest size."""
_STRANGERS = 16
"""Requests under way of those who need no token: they must not take the places of those who have one."""
_THREADS = 8
"""For what a renewal needs of the database: others' requests are not waited for."""
_THREADS_OF_STRANGERS = 4
"""To look tokens up that nobody has shown lately: made-up ones take no thread of those who are known."""


class Authenticator(Protocol):
    """Knows tokens."""

    def authenticate(self, token: str | None, address: str) -> Principal:
        """Who owns a token that came from an address; may wait, for a database.

        Raises:
            DomainError: Nobody, or too often.
        """

    def recent(self, token: str | None, address: str) -> Principal | None:
        """The same at once, if it was known a moment ago; takes no request of who was.

        Raises:
            DomainError: Nobody, as was found a moment ago, or too often.
        """

    def spend(self, caller: Principal) -> None:
        """Take a request of who was known a moment ago, at once.

        Raises:
            TooManyError: They asked too often.
        """

    def verify(self, token: str | None) -> Principal:
        """As ``authenticate``, without taking a request."""

    def charge(self, caller: Principal, length: int) -> None:
        """Reckon what a body of this length costs whoever sent it."""


class Admission:
    """ASGI middleware: authenticates, reads the body, and bounds the requests under way."""

    def __init__(
        self,
        app: ASGIApp,
        authenticator: Authenticator,
        limits: ServerLimits,
        overload: Overload,
        refusal_delay: RefusalDelay,
        on_renewed: Callable[[float], None] = lambda _: None,
    ) -> None:
        """Bounds are those of ``limits``.

        Args:
            app: Serves.
            authenticator: Knows tokens.
            limits: How much and how many.
            overload: Told when a robot that wants to renew is refused.
            refusal_delay: Before some refusals.
            on_renewed: Told how long a renewal took [s].
        """
        self._app = app
        self._authenticator = authenticator
        self._limits = limits
        self._overload = overload
        self._places, self._strangers = _Places(), _Places()
        self._of: Counter[str] = Counter()
        self._held = 0
        self._refusal_delay = refusal_delay
        self._on_renewed = on_renewed
        self._for_renewals = _Threads(_THREADS)
        self._for_strangers = _Threads(_THREADS_OF_STRANGERS)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http":
            return await self._app(scope, receive, send)
        began = time.monotonic()
        if scope["path"] == _FREE:
            return await self._app(scope, _nothing, send)
        if not scope["path"].startswith(_API):  # whatever is open to all, or asks for a token itself, takes no body
            return await self._place(scope, b"", send, renewal=False)
        if _ASTRAY.search(scope["path"]):
            text = "a path goes down, by names: none of them is empty or made of dots"
            await self._refusal_delay.wait()
            return await answer(Request(scope), 404, "Not found", text)(scope, receive, send)
        renewal = scope["method"] == "POST" and _RENEWAL.fullmatch(scope["path"]) is not None
        try:
            caller = await self._who(scope, renewal)
        except Exception as error:  # whatever it is, there is one place that knows what to say of it
            if isinstance(error, TooManyError) and error.who:
                scope.setdefault("state", {})["who"] = error.who  # for the audit: a good token was shown
            if isinstance(error, UnauthenticatedError | TooManyError):
                await self._refusal_delay.wait()
            return await (await answer_to(Request(scope), error))(scope, receive, send)
        with contextlib.ExitStack() as until_answered:
            if until_answered.enter_context(self._one_of(caller)):
                told = self._timed(began, send) if renewal else send
                return await self._serve(scope, receive, told, caller, until_answered, renewal=renewal)
            text = f"{self._limits.robot_requests_at_once} requests of this robot are under way: wait for their answers"
            await self._refusal_delay.wait()
            return await (await answer_to(Request(scope), TooManyError(1.0, text)))(scope, receive, send)

    async def _serve(
        self,
        scope: Scope,
        receive: Receive,
        send: Send,
        caller: Principal,
        until_answered: contextlib.ExitStack,
        *,
        renewal: bool,
    ) -> None:
        """Read the body of somebody we know, and pass the request on."""
        limits = self._limits
        with _Body(self, limits.body_bytes if caller.robot is None else limits.robot_body_bytes) as body:
            try:
                await body.read(scope, receive)
            except _RefusedError as why:
                if renewal and why.busy:
                    self._overload.note()
                return await why.answer(Request(scope))(scope, receive, send)
            except _LeftError:
                return None
            whole = bytes(body.data)
        self._authenticator.charge(caller, len(whole))
        return await self._place(scope, whole, send, renewal=renewal, receive=receive, until_answered=until_answered)

    async def _who(self, scope: Scope, renewal: bool) -> Principal:
        kind, _, token = Headers(scope=scope).get("authorization", "").partition(" ")
        given = token.strip() if kind.lower() == "bearer" else None
        address = scope["client"][0] if scope.get("client") else ""
        run: Callable[..., Awaitable[Any]] = self._for_renewals.run if renewal else to_thread.run_sync
        recent = self._authenticator.recent(given, address)
        caller: Principal
        if recent is None:
            caller = await self._for_strangers.run(self._authenticator.authenticate, given, address)
        elif _PROBE.fullmatch(scope["path"]):  # what measures a round trip is not to measure a database too
            caller = recent
        elif renewal:  # the thread that renews asks first: each change of thread waits for its turn
            self._authenticator.spend(recent)
            caller, run = recent, partial(self._for_renewals.run, _verified, self._authenticator, given)
        else:
            caller = await run(self._authenticator.authenticate, given, address)
        scope.setdefault("state", {}).update({PRINCIPAL: caller, "who": caller.owner, RUN: run})
        if (connection := scope.get(CONNECTION)) is not None:
            connection.know(caller.owner)
        return caller

    @contextlib.contextmanager
    def _one_of(self, caller: Principal) -> Iterator[bool]:
        """Whether a robot may have another one under way."""
        if caller.robot is None:
            yield True
            return
        if self._of[caller.owner] >= self._limits.robot_requests_at_once:
            yield False
            return
        self._of[caller.owner] += 1
        try:
            yield True
        finally:
            self._of[caller.owner] -= 1
            if not self._of[caller.owner]:
                del self._of[caller.owner]

    def hold(self, count: int) -> bool:
        """Whether there is room for more bytes of bodies that have not arrived whole; a negative count gives back."""
        if count > 0 and self._held + count > _MOST_HELD:
            return False
        self._held += count
        return True

    async def _place(
        self,
        scope: Scope,
        body: bytes,
        send: Send,
        *,
        renewal: bool,
        receive: Receive | None = None,
        until_answered: contextlib.ExitStack | None = None,
    ) -> None:
        """Serve it where there is a place; without ``receive`` the caller has shown no token.

        What ``until_answered`` holds is let go when an answer begins: a stream is no request under way.
        """
        counts, most = (self._places, self._most(renewal)) if receive is not None else (self._strangers, _STRANGERS)
        if counts.taken >= most:
            if renewal:
                self._overload.note()
            text = f"{most} requests are under way already: try again in a second"
            refusal = answer(Request(scope), 503, "Too busy", text, headers={"Retry-After": "1"})
            await refusal(scope, _nothing, send)
            return
        with until_answered or contextlib.ExitStack() as held:
            held.enter_context(counts.one())
            if renewal:
                held.enter_context(self._overload.renewing())

            async def noting(message: Message) -> None:
                if message["type"] == "http.response.start":
                    held.close()
                    if receive is None and message["status"] == _NOT_FOUND:
                        await self._refusal_delay.wait()
                await send(message)

            await self._app(scope, _replaying(body, receive), noting)

    def _timed(self, began: float, send: Send) -> Send:
        async def timing(message: Message) -> None:
            if message["type"] == "http.response.start" and message["status"] == _OK:
                self._on_renewed(time.monotonic() - began)
            await send(message)

        return timing

    def _most(self, renewal: bool) -> int:
        limits = self._limits
        return limits.requests_at_once if renewal else max(1, limits.requests_at_once - limits.requests_for_renewals)


class _Threads:
    """A few that are kept for one kind of work."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._limiter: CapacityLimiter | None = None
        """Made where there is a loop."""

    async def run(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Run a function in one of them."""
        if self._limiter is None:
            self._limiter = CapacityLimiter(self._most)
        value, error = await to_thread.run_sync(_tried, function, *arguments, limiter=self._limiter)
        if error is None:
            return value
        try:
            raise error
        finally:
            del error  # its traceback holds this frame: refusals would wait for the collector, which holds up everybody


def _tried(function: Callable[..., Any], *arguments: Any) -> tuple[Any, Exception | None]:
    """What it returns, or what it raises; raised through a thread's future, an error and that hold each other."""
    try:
        return function(*arguments), None
    except Exception as error:
        return None, error


def _verified(authenticator: Authenticator, token: str | None, function: Callable[..., Any], *arguments: Any) -> Any:
    authenticator.verify(token)
    return function(*arguments)


class _Places:
    """How many are taken. Streams count until they begin only, so watching many instances keeps nobody out."""

    taken = 0

    @contextlib.contextmanager
    def one(self) -> Iterator[None]:
        self.taken += 1
        try:
            yield
        finally:
            self.taken -= 1


class _LeftError(Exception):
    """The sender is gone."""


class _RefusedError(Exception):
    """The body is not taken."""

    def __init__(self, status: int, title: str, text: str) -> None:
        super().__init__(text)
        self._said = status, title, text
        self.busy = status == _BUSY
        """There was no room; its sender did nothing wrong."""

    def answer(self, request: Request) -> Response:
        status, title, text = self._said
        return answer(request, status, title, text, headers={"Retry-After": "1"} if self.busy else {})


class _Body:
    """One that arrives; what it holds is given back at the end."""

    def __init__(self, admission: Admission, limit: int) -> None:
        self._reception = admission
        self._limit = limit
        self.data = bytearray()

    def __enter__(self) -> _Body:
        return self

    def __exit__(self, *_: object) -> None:
        self._reception.hold(-len(self.data))

    async def read(self, scope: Scope, receive: Receive) -> None:
        """All of it.

        Raises:
            _RefusedError: It is too large, or there is no room.
            _LeftError: Its sender has left, or was too slow.
        """
        declared = Headers(scope=scope).get("content-length", "")
        self._check(int(declared) if declared.isdigit() else 0)
        while True:
            message = await receive()
            if message["type"] != "http.request":
                raise _LeftError
            chunk = message.get("body", b"")
            self._check(len(self.data) + len(chunk))
            if not self._reception.hold(len(chunk)):
                raise _RefusedError(
                    _BUSY, "Too busy", "too many large requests are on their way: try again in a second"
                )
            self.data += chunk
            if not message.get("more_body", False):
                return

    def _check(self, length: int) -> None:
        if length > self._limit:
            raise _RefusedError(413, "Too large", f"the request is larger than {self._limit} bytes")


def _replaying(body: bytes, receive: Receive | None) -> Receive:
    """Gives the body, and from then on what the server says: that the sender has left."""
    given = False

    async def replay() -> Message:
        nonlocal given
        if not given:
            given = True
            return {"type": "http.request", "body": body, "more_body": False}
        if receive is None:
            return await _nothing()
        while (message := await receive())["type"] == "http.request":
            pass
        return message

    return replay


async def _nothing() -> Message:
    return {"type": "http.request", "body": b"", "more_body": False}
