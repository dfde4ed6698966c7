"""What routers ask for: the orchestrator, and who is asking."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import Depends, Request
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer

from skytether.api.rest import Problem

from ..access import Principal
from ..core import Orchestrator

PREFIX = "/api/v1"

bearer = HTTPBearer(auto_error=False, description="The operator's token, or a robot's")


def _core(request: Request) -> Orchestrator:
    core: Orchestrator = request.app.state.core
    return core


Core = Annotated[Orchestrator, Depends(_core)]


def _caller(core: Core, bearer: Annotated[HTTPAuthorizationCredentials | None, Depends(bearer)]) -> Principal:
    return core.access.authenticate(bearer.credentials if bearer else None)


Caller = Annotated[Principal, Depends(_caller)]
"""Anybody with a token."""


def _operator(caller: Caller) -> Principal:
    caller.require_operator()
    return caller


Operator = Annotated[Principal, Depends(_operator)]
"""The operator, and nobody else."""


def says(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """For the API's description: the errors that a route can answer, each a problem document."""
    content = {"application/problem+json": {"schema": {"$ref": "#/components/schemas/Problem"}}}
    return {status: {"model": Problem, "content": content} for status in statuses}
