"""The one place where errors become HTTP: problem documents (RFC 9457), one sentence each, never a traceback."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from sqlalchemy.exc import ProgrammingError
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from skytether.api.faults import faults
from skytether.api.rest import Problem

from .db import GONE
from .errors import (
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

if TYPE_CHECKING:
    from .core import Orchestrator

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
    413: ("Too large", "the request is larger than {limit} bytes"),
}


def install(app: FastAPI, body_limit: int) -> None:
    """Make an app answer every error with a problem document."""

    async def on_domain(request: Request, error: Exception) -> JSONResponse:
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

    async def on_invalid(request: Request, error: Exception) -> JSONResponse:
        if not isinstance(error, RequestValidationError):
            raise error
        found = [_explain(app, request, one) for one in error.errors()]
        detail = "; ".join(str(fault) for fault in found)
        return answer(request, 422, "Invalid input", detail, [_fault(fault) for fault in found])

    async def on_http(request: Request, error: Exception) -> JSONResponse:
        if not isinstance(error, HTTPException):
            raise error
        title, text = _HTTP.get(error.status_code, ("Error", "{detail}"))
        values = {"path": request.url.path, "method": request.method, "limit": body_limit, "detail": error.detail}
        return answer(request, error.status_code, title, text.format(**values), headers=dict(error.headers or {}))

    async def on_database(request: Request, error: Exception) -> JSONResponse:
        log.warning("%s %s: the database does not answer (%s)", request.method, request.url.path, type(error).__name__)
        text = "the orchestrator's database does not answer: try again in a few seconds"
        return answer(request, 503, "Not possible now", text, headers={"Retry-After": _RETRY_AFTER})

    async def on_schema(request: Request, error: Exception) -> JSONResponse:
        core: Orchestrator = request.app.state.core
        outdated = await asyncio.to_thread(core.look_outdated)
        return await (on_domain(request, OutdatedError()) if outdated else on_anything(request, error))

    async def on_anything(request: Request, error: Exception) -> JSONResponse:
        log.error("%s %s failed", request.method, request.url.path, exc_info=error)
        return answer(request, 500, "Internal error", "a mistake in the orchestrator: its log has the details")

    app.add_exception_handler(DomainError, on_domain)
    app.add_exception_handler(RequestValidationError, on_invalid)
    app.add_exception_handler(HTTPException, on_http)
    app.add_exception_handler(ProgrammingError, on_schema)
    for gone in GONE:
        app.add_exception_handler(gone, on_database)
    app.add_exception_handler(Exception, on_anything)
    app.add_middleware(BodyLimit, limit=body_limit)


class BodyLimit:
    """ASGI middleware: a request that is too large, or says that it is, is answered with 413 once somebody reads it."""

    def __init__(self, app: ASGIApp, limit: int) -> None:
        """``limit`` in bytes."""
        self._app = app
        self._limit = limit

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http":
            return await self._app(scope, receive, send)
        declared = Headers(scope=scope).get("content-length", "")
        largest = int(declared) if declared.isdigit() else 0
        received = 0

        async def limited() -> Message:
            nonlocal received
            if largest > self._limit:
                raise HTTPException(413)
            message = await receive()
            received += len(message.get("body", b""))
            if received > self._limit:
                raise HTTPException(413)
            return message

        return await self._app(scope, limited, send)


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


def _explain(app: FastAPI, request: Request, error: dict[str, Any]) -> Fault:
    """One of FastAPI's errors; its place begins with where it was: body, query, path or header."""
    where, *path = error["loc"]
    if error["type"] == "json_invalid":
        return Fault("", f"the body is no JSON: {error['ctx']['error'].lower()} at character {path[0]}")
    schema = _body_schema(app, request) if where == "body" else {}
    fault = faults([{**error, "loc": path}], schema)[0]
    return fault if fault.key else Fault(str(where), fault.detail)


def _body_schema(app: FastAPI, request: Request) -> dict[str, Any]:
    """JSON schema of the body that this request should have had, from the API's own description."""
    document = app.openapi()
    route = request.scope.get("route")
    operation = document["paths"].get(getattr(route, "path", ""), {}).get(request.method.lower(), {})
    content = operation.get("requestBody", {}).get("content", {}).get("application/json", {})
    definitions = document.get("components", {}).get("schemas", {})
    return {**_plain_refs(content.get("schema", {})), "$defs": _plain_refs(definitions)}


def _plain_refs(node: Any) -> Any:
    """References as a schema of its own has them."""
    if isinstance(node, dict):
        return {k: _plain_refs(v) if k != "$ref" else v.replace("components/schemas", "$defs") for k, v in node.items()}
    return [_plain_refs(child) for child in node] if isinstance(node, list) else node
