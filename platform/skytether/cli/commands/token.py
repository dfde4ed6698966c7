"""``skytether token``: who may ask, and what."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from .. import names
from ..connection import Json, TokenFile, Url, connected
from ..names import need
from ..options import checked
from ..output import console, or_dash, plain, print_json, print_table

if TYPE_CHECKING:
    from skytether.api.rest import TokenCreated

app = typer.Typer(help="Tokens of robots and operators.", no_args_is_help=True)

_DAY = 86_400.0
Days = Annotated[
    float | None, typer.Option(min=0.001, max=3650, help="How long it is good for; without it until it is deleted.")
]


@app.command("list")
def list_tokens(url: Url = None, token_file: TokenFile = None, json: Json = False) -> None:
    """List all tokens but the operator's of the state folder; never the tokens themselves."""
    with connected(url, token_file) as client:
        found = client.tokens()
    if json:
        print_json([plain(token) for token in found])
        return
    rows = [
        (t.id, t.name, or_dash(t.robot), ", ".join(t.scopes) or "-", or_dash(t.expires_at), or_dash(t.last_used_at))
        for t in found
    ]
    print_table(("token", "name", "robot", "scopes", "expires", "last used"), rows)


@app.command("create")
def create_token(
    name: Annotated[str, typer.Argument(help="To tell it from others.")],
    robot: Annotated[
        str | None, typer.Option(help="For this robot; without it for an operator.", autocompletion=names.robots)
    ] = None,
    scope: Annotated[
        list[str] | None,
        typer.Option(
            help="read, instances, sessions, catalog, sites, robots, tokens or metrics; may be given again.",
            autocompletion=names.scopes,
        ),
    ] = None,
    days: Days = None,
    url: Url = None,
    token_file: TokenFile = None,
    json: Json = False,
) -> None:
    """Make a token. It is printed on standard output, this once."""
    from skytether.api.rest import TokenCreate

    asked = {"name": name, "robot": robot, "scopes": scope or (), "ttl_s": None if days is None else days * _DAY}
    request = checked(TokenCreate, asked)
    with connected(url, token_file) as client:
        _show(client.create_token(request), json)


@app.command("rotate")
def rotate_token(
    token: Annotated[
        str | None,
        typer.Argument(help="Its id; without it the one that this command uses.", autocompletion=names.tokens),
    ] = None,
    grace_s: Annotated[float, typer.Option(min=0, max=30 * _DAY, help="How long the old one is good still.")] = 300,
    days: Annotated[
        float | None,
        typer.Option(min=1 / _DAY, help="How long the new one is good for; without it until the end of the old one."),
    ] = None,
    url: Url = None,
    token_file: TokenFile = None,
    json: Json = False,
) -> None:
    """Make a token with the same rights and the same end, and let the old one end soon."""
    from skytether.api.rest import TokenRotate

    with connected(url, token_file) as client:
        _show(
            client.rotate_token(token, TokenRotate(grace_s=grace_s, ttl_s=None if days is None else days * _DAY)), json
        )


@app.command("delete")
def delete_token(
    token: Annotated[str, typer.Argument(help="Its id.", autocompletion=names.tokens)],
    url: Url = None,
    token_file: TokenFile = None,
) -> None:
    """Revoke a token by its id, and those that it was renewed by."""
    with connected(url, token_file) as client:
        need("token", token, lambda: [id_ for row in client.tokens() for id_ in (row.id, row.family)])
        client.delete_token(token)


def _show(made: TokenCreated, json: bool) -> None:
    if json:
        print_json(plain(made))
        return
    console.print(f"token {made.id} ({made.name}), which cannot be shown again:")
    typer.echo(made.token)
