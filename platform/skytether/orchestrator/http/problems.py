"""The one place where errors become HTTP: problem documents (RFC 9457), one sentence each, never a traceback."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import TypeAdapter
from sqlalchemy.exc import ProgrammingError
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from skytether.api.rest import Problem
from skytether.api.validation_errors import MAX_FAULTS, faults

from ..domain.errors import (
    ConflictError,
    DomainError,
    Fault,
    ForbiddenError,
    InvalidError,
    NoSiteError,
    NotFoundError,
    OutdatedError,
    SilentSiteError,
    TooManyError,
    UnauthenticatedError,
)
from ..store.engine import GONE

if TYPE_CHECKING:
    from ..core import Orchestrator

log = logging.getLogger(__name__)

MEDIA_TYPE = "application/problem+json"
STATUS: dict[type[DomainError], tuple[int, str]] = {
    UnauthenticatedError: (401, "No valid token"),
    ForbiddenError: (403, "Not allowed"),
    NotFoundError: (404, "Not found"),
    TooManyError: (429, "Too many requests"),
    NoSiteError: (409, "No site fits"),
    ConflictError: (409, "Not possible now"),
    InvalidError: (422, "Invalid input"),
    OutdatedError: (503, "Not possible now"),
    SilentSiteError: (503, "Not possible now"),
}
"""Status and title of each kind of error."""
_RETRY_AFTER = "2"
"""Seconds, to somebody who asked when the database was away or another's."""
_HTTP = {
    400: ("Invalid input", "the body is no JSON that can be read"),
    404: ("Not found", "there is nothing at {path}: see /docs for what there is"),
    405: ("Method not allowed", "{method} is not possible on {path}: see /docs for what is"),
}


def install(app: FastAPI) -> None:
    """Make an app answer every error with a problem document."""
    schemas: dict[tuple[str, str], dict[str, Any]] = {}

    def body_schema(request: Request) -> dict[str, Any]:
        """JSON schema of the body that this request should have had.

        Made once for each route: whoever asks in vain costs the others nothing. The whole API's takes a second.
        """
        route = request.scope.get("route")
        key = getattr(route, "path", ""), request.method  # routes cannot be keys themselves
        if key not in schemas:
            body = getattr(route, "body_field", None)
            schemas[key] = {} if body is None else TypeAdapter(body.field_info.annotation).json_schema()
        return schemas[key]

    async def on_invalid(request: Request, error: Exception) -> JSONResponse:
        if not isinstance(error, RequestValidationError):
            raise error
        schema = body_schema(request)
        found = [_explain(one, schema) for one in error.errors()[:MAX_FAULTS]]
        detail = "; ".join(str(fault) for fault in found)
        return answer(request, 422, "Invalid input", detail, [_fault(fault) for fault in found])

    async def on_http(request: Request, error: Exception) -> JSONResponse:
        if not isinstance(error, HTTPException):
            raise error
        title, text = _HTTP.get(error.status_code, ("Error", "{detail}"))
        values = {"path": request.url.path, "method": request.method, "detail": error.detail}
        return answer(request, error.status_code, title, text.format(**values), headers=dict(error.headers or {}))

    app.add_exception_handler(DomainError, answer_to)
    app.add_exception_handler(RequestValidationError, on_invalid)
    app.add_exception_handler(HTTPException, on_http)
    for kind in (ProgrammingError, *GONE, Exception):
        app.add_exception_handler(kind, answer_to)


class GivenUp:
    """ASGI middleware: whoever still waits when the orchestrator ends is told to ask again, and a stream ends there.

    The server cancels what takes too long then, would answer that it made a mistake (500), and writes a traceback.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        begun = streams = False

        async def noting(message: Message) -> None:
            nonlocal begun, streams
            if message["type"] == "http.response.start":
                streams = all(name.lower() != b"content-length" for name, _ in message.get("headers", ()))
            begun = True
            await send(message)

        try:
            await self._app(scope, receive, noting)
        except asyncio.CancelledError:
            if streams:  # it goes on elsewhere, from what came last
                await send({"type": "http.response.body"})
                return
            if begun or scope["type"] != "http":
                raise
            headers = {"Retry-After": _RETRY_AFTER, "Connection": "close"}
            text = "the orchestrator ends, and has not done this in time: ask again"
            await answer(Request(scope), 503, "Not possible now", text, headers=headers)(scope, receive, send)


async def answer_to(request: Request, error: Exception) -> JSONResponse:
    """What is said of an error that a request met, wherever it was raised."""
    if isinstance(error, DomainError):
        return _on_domain(request, error)
    if isinstance(error, GONE):
        name = type(error).__name__
        log.warning("%s %s: the database does not answer (%s)", request.method, request.url.path, name)
        text = "the orchestrator's database does not answer: try again in a few seconds"
        return answer(request, 503, "Not possible now", text, headers={"Retry-After": _RETRY_AFTER})
    if isinstance(error, ProgrammingError):
        core: Orchestrator = request.app.state.core
        if await asyncio.to_thread(core.check_outdated):
            return _on_domain(request, OutdatedError())
    log.error("%s %s failed", request.method, request.url.path, exc_info=error)
    return answer(request, 500, "Internal error", "a mistake in the orchestrator: its log has the details")


def _on_domain(request: Request, error: DomainError) -> JSONResponse:
    status, title = next(STATUS[kind] for kind in type(error).__mro__ if kind in STATUS)
    errors: list[dict[str, Any]] = []
    if isinstance(error, InvalidError):
        errors = [_fault(fault) for fault in error.faults]
    elif isinstance(error, NoSiteError):
        errors = list(error.refused)
    headers = {"WWW-Authenticate": "Bearer"} if status == 401 else {}
    if isinstance(error, TooManyError):
        headers["Retry-After"] = str(error.retry_after)
    if isinstance(error, OutdatedError):
        # A proxy's next request is to find another orchestrator, not this connection.
        headers |= {"Retry-After": _RETRY_AFTER, "Connection": "close"}
    return answer(request, status, title, str(error), errors, headers)


def answer(
    request: Request,
    status: int,
    title: str,
    detail: str,
    errors: list[dict[str, Any]] | None = None,
    headers: dict[str, str] | None = None,
) -> JSONResponse:
    """A problem document as an answer."""
    problem = Problem(title=title, status=status, detail=detail, instance=request.url.path, errors=tuple(errors or ()))
    return JSONResponse(problem.model_dump(mode="json"), status, headers, media_type=MEDIA_TYPE)


def _fault(fault: Fault) -> dict[str, Any]:
    return {"key": fault.key, "detail": fault.detail}


def _explain(error: dict[str, Any], body_schema: dict[str, Any]) -> Fault:
    """One of FastAPI's errors; its place begins with where it was: body, query, path or header."""
    where, *path = error["loc"]
    if error["type"] == "json_invalid":
        return Fault("", f"the body is no JSON: {error['ctx']['error'].lower()} at character {path[0]}")
    fault = faults([{**error, "loc": path}], body_schema if where == "body" else {})[0]
    return fault if fault.key else Fault(str(where), fault.detail)
