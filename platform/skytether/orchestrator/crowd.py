"""A bound on the requests under way: who comes beyond it is told at once to come again, and the others are served."""

from __future__ import annotations

from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from .problems import answer

_FREE = "/healthz"
"""Costs nothing; and to take an orchestrator for dead because it has much to do would help nobody."""


class Crowd:
    """ASGI middleware: 503 with ``Retry-After`` beyond a number of requests whose answers have not begun.

    Streams count until they begin only, so watching many instances keeps nobody out.
    """

    def __init__(self, app: ASGIApp, most: int) -> None:
        """``most``: requests under way."""
        self._app = app
        self._most = most
        self._under_way = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http" or scope["path"] == _FREE:
            return await self._app(scope, receive, send)
        if self._under_way >= self._most:
            text = f"{self._most} requests are under way already: try again in a second"
            refusal = answer(Request(scope), 503, "Too busy", text, headers={"Retry-After": "1"})
            return await refusal(scope, receive, send)
        self._under_way += 1
        counted = True

        async def noting(message: Message) -> None:
            nonlocal counted
            if counted and message["type"] == "http.response.start":
                counted = False
                self._under_way -= 1
            await send(message)

        try:
            await self._app(scope, receive, noting)
        finally:
            self._under_way -= counted
