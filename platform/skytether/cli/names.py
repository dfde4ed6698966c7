"""Names of services, sites, instances: completed by a shell, quickly or not at all, and looked for when mistyped."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Context

from .output import fail

if TYPE_CHECKING:
    from skytether.api.client import Client

_PATIENCE_S = 1.0
"""Whoever pressed the key is waiting."""
_PLAIN = re.compile(r"[\w.,+() -]*", re.ASCII)
"""What is left of an orchestrator's words: zsh evaluates what it is told."""
Names = Callable[[Context, str], list[tuple[str, str]]]


def completion(ask: Callable[[Client], Iterable[tuple[str, str]]]) -> Names:
    """Of what ``ask`` gives, names with a word on each, those that begin so."""

    def complete(ctx: Context, incomplete: str) -> list[tuple[str, str]]:
        given: dict[str, Any] = ctx.params
        try:
            from skytether.api.client import Client

            from .connection import local_token, local_url, transport

            url = given.get("url") or os.environ.get("SKYTETHER_URL")
            file = given.get("token_file") or os.environ.get("SKYTETHER_TOKEN_FILE")
            token = local_token(Path(file) if file else None)
            with Client(url or local_url(), token, timeout=_PATIENCE_S, **transport(url)) as client:
                return [row for row in ask(client) if row[0].startswith(incomplete) and all(map(_PLAIN.fullmatch, row))]
        except (Exception, SystemExit):  # a key that was pressed must not be answered with a complaint
            return []

    return complete


services = completion(lambda client: [(m.metadata.name, f"version {m.metadata.version}") for m in client.services()])
sites = completion(lambda client: [(s.name, f"{s.tier}, {s.state}") for s in client.sites()])
groups = completion(lambda client: [(g.name, f"{g.provider}, {len(g.machines)} of {g.max}") for g in client.groups()])
robots = completion(lambda client: [(r.name, ", ".join(r.services)) for r in client.robots()])
tokens = completion(lambda client: [(t.id, t.name) for t in client.tokens()])
instances = completion(
    lambda client: [(i.id, f"{i.service} for {i.robot or 'nobody'}, {i.state}") for i in client.instances()]
)


def scopes(incomplete: str) -> list[str]:
    """What a token may."""
    from skytether.api.rest import SCOPES

    return [scope for scope in SCOPES if scope.startswith(incomplete)]


ServiceName = Annotated[str, typer.Argument(help="Its name.", autocompletion=services)]
SiteName = Annotated[str, typer.Argument(help="Its name.", autocompletion=sites)]
InstanceId = Annotated[str, typer.Argument(help="Its id.", autocompletion=instances)]


def need(kind: str, name: str, there: Callable[[], list[str]]) -> None:
    """End with the name that was meant where there is none of this one: a slip must not look like something done.

    ``there`` asks for those there are; a token that may not see them does without.
    """
    from skytether.api.client import ApiError
    from skytether.api.validation_errors import known

    try:
        found = there()
    except ApiError as error:
        if error.problem.status != 403:
            raise
        return
    if name not in found:
        fail(f"there is no {kind} '{name}'; {known(found, name)}")
