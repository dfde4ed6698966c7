"""What routers ask for: the orchestrator, and who is asking."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Annotated, Any

from fastapi import Depends, Request, Response
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer

from skytether.api.document_checks import oddity
from skytether.api.rest import PATH_NAME, Problem, Scope

from ...access.access import Principal
from ...core import Orchestrator
from ...domain.errors import InvalidError, NotFoundError
from ..admission import PRINCIPAL, RUN

PREFIX = "/api/v1"
_LARGE = 16_384
"""Bytes of a body that is not looked through between other requests, but beside them."""

bearer = HTTPBearer(auto_error=False, description="An operator's token, or a robot's")


async def _core(request: Request) -> Orchestrator:
    core: Orchestrator = request.app.state.core
    return core


Core = Annotated[Orchestrator, Depends(_core)]


Bearer = Annotated[HTTPAuthorizationCredentials | None, Depends(bearer)]


async def _asker(request: Request, _: Bearer) -> Principal:
    known: Principal = getattr(request.state, PRINCIPAL)  # the admission has asked
    return known


def authenticated(core: Orchestrator, request: Request, token: HTTPAuthorizationCredentials | None) -> Principal:
    """Whoever sends this token, where not everybody needs one.

    Raises:
        OutdatedError: This orchestrator has no say any more.
        UnauthenticatedError: Nobody we know.
        TooManyError: They asked too often.
    """
    address = request.client.host if request.client else ""
    principal = core.authenticate(token.credentials if token else None, address)
    request.state.who = principal.owner  # for the audit
    return principal


async def _thread(request: Request) -> Callable[..., Awaitable[Any]]:
    run: Callable[..., Awaitable[Any]] = getattr(request.state, RUN)
    return run


InThread = Annotated[Callable[..., Awaitable[Any]], Depends(_thread)]
"""Runs a function beside the loop, in a thread for this kind of request."""
Authenticated = Annotated[Principal, Depends(_asker)]
"""Anybody with a token, whatever it may."""


def _holder(scope: Scope, *, robots: bool = False) -> Any:
    async def check(caller: Authenticated) -> Principal:  # what does not wait needs no thread to wait in
        caller.require_scope(scope, robots=robots)
        return caller

    return Depends(check)


Caller = Annotated[Principal, _holder("read", robots=True)]
"""A robot, or an operator who may read: for looking."""
Actor = Annotated[Principal, _holder("instances", robots=True)]
"""A robot, or an operator who may change instances."""
InstancesOperator = Annotated[Principal, _holder("instances")]
"""An operator who may change instances."""
KeyHolder = Annotated[Principal, _holder("sessions", robots=True)]
"""A robot, or an operator who may have keys of sessions."""
Reader = Annotated[Principal, _holder("read")]
CatalogOperator = Annotated[Principal, _holder("catalog")]
SitesOperator = Annotated[Principal, _holder("sites")]
RobotsOperator = Annotated[Principal, _holder("robots")]
TokensOperator = Annotated[Principal, _holder("tokens")]


def made(response: Response, kind: str, id_: str) -> None:
    """Say where what was just made can be found; the audit notes it too."""
    response.headers["Location"] = f"{PREFIX}/{kind}/{id_}"


def says(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """For the API's description: the errors that a route can answer, each a problem document."""
    content = {"application/problem+json": {"schema": {"$ref": "#/components/schemas/Problem"}}}
    return {status: {"model": Problem, "content": content} for status in statuses}


async def plain_request(request: Request) -> None:
    """Refuse what could be stored but never given back, and what a database does not take, wherever it is.

    Raises:
        InvalidError: It is in the body.
        NotFoundError: It is in the path.
    """
    for name, value in request.path_params.items():
        if not PATH_NAME.fullmatch(value):
            raise NotFoundError(f"there is no {name} of that name: names are letters, digits, '-' and '_'")
    body = await request.body()
    try:
        document = await request.json() if body else None
    except ValueError:
        return  # whoever wants it says what it should have been
    fault = oddity(document, body) if len(body) < _LARGE else await asyncio.to_thread(oddity, document, body)
    if fault is not None:
        raise InvalidError([fault])
