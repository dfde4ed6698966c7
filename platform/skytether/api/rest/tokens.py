"""Tokens of robots and operators."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Literal, get_args

from pydantic import Field

from skytether.api.manifest import Name, Strict

TokenLife = Annotated[float, Field(ge=1, le=10 * 365 * 86_400)]
"""Seconds that a token is good for."""


Scope = Literal["read", "instances", "sessions", "catalog", "sites", "robots", "tokens", "metrics"]
"""What an operator's token may: see everything but keys; change instances; get the keys of sessions (and so speak as a
robot or its service); change catalog, sites, robots, tokens; read /metrics."""
SCOPES: tuple[Scope, ...] = get_args(Scope)


class TokenCreate(Strict):
    """Another token: a robot's, or an operator's with some scopes."""

    name: Name
    """For people, to tell it from others: no two of a robot, or of operators, have the same."""
    robot: Name | None = None
    scopes: tuple[Scope, ...] = ()
    ttl_s: TokenLife | None = None
    """How long it is good for; None: until it is deleted."""


class TokenRotate(Strict):
    """Another token instead of one."""

    grace_s: Annotated[float, Field(ge=0, le=30 * 86_400)] = 300
    """How long the old one is good for still."""
    ttl_s: TokenLife | None = None
    """How long the new one is good for, for who may make such tokens; None: until the end of the old one."""


class Token(Strict):
    """What is known of a token; never the token itself."""

    id: str
    name: str
    robot: str | None = None
    scopes: tuple[Scope, ...] = ()
    family: str = ""
    """The same for a token and the one that it was renewed by."""
    created_at: datetime
    expires_at: datetime | None = None
    last_used_at: datetime | None = None


class TokenCreated(Token):
    """The only time that the token is shown."""

    token: Annotated[str, Field(repr=False)]
