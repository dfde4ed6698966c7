"""Which orchestrator a command speaks to, and with whose token."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypedDict

import typer

from skytether.orchestrator.config.defaults import DEFAULT_HOST, DEFAULT_PORT, default_state_dir

from .output import fail

if TYPE_CHECKING:
    from skytether.api.client import Client


Url = Annotated[
    str | None,
    typer.Option(
        "--url",
        envvar="SKYTETHER_URL",
        help="Of the orchestrator, or of several, with commas; without it the one of this machine.",
        show_default=False,
    ),
]
TokenFile = Annotated[
    Path | None,
    typer.Option(
        "--token-file",
        envvar="SKYTETHER_TOKEN_FILE",
        help="File with a token; SKYTETHER_TOKEN may hold one too; without both the operator's of this machine.",
        show_default=False,
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON document, and nothing else.")]


@contextmanager
def connected(url: str | None, token_file: Path | None) -> Iterator[Client]:
    """A client; what goes wrong in the block ends the command with one sentence."""
    from skytether.api.client import ApiError, Client, NotRunning, Unreachable

    try:
        with Client(url or local_url(), _token(token_file), **transport(url)) as client:
            yield client
    except (ApiError, NotRunning, Unreachable) as error:
        fail(str(error))
    except KeyboardInterrupt:
        fail("interrupted", 130)


class Transport(TypedDict):
    """How a client sends its requests."""

    ca_file: str | None
    insecure_http: bool


def transport(url: str | None) -> Transport:
    """What the environment says of it; None: to the orchestrator of this machine, which nothing leaves."""
    from skytether.api.plain_http import VARIABLE, is_allowed

    allowed = url is None or is_allowed(os.environ.get(VARIABLE))
    return {"ca_file": os.environ.get("SKYTETHER_CA_FILE"), "insecure_http": allowed}


def local_url() -> str:
    """Of the orchestrator of this machine and user."""
    try:
        return (default_state_dir() / "address").read_text().strip()
    except OSError:
        return f"http://{DEFAULT_HOST}:{DEFAULT_PORT}"


def _token(given: Path | None) -> str:
    path = given or default_state_dir() / "operator.token"
    try:
        return local_token(given)
    except FileNotFoundError:
        if given is None:
            return ""  # nothing runs here, or it is another user's: the answer will say which
        fail(f"there is no token file {path}", 2)
    except (OSError, UnicodeDecodeError) as error:
        fail(f"cannot read the token file {path}: {getattr(error, 'strerror', None) or 'it is no text'}", 2)


def local_token(given: Path | None) -> str:
    """A file named on the command line goes before the environment, and that before this machine's.

    Raises:
        OSError: It cannot be read.
        UnicodeDecodeError: It is no text.
    """
    if given is None and os.environ.get("SKYTETHER_TOKEN"):
        return os.environ["SKYTETHER_TOKEN"].strip()
    return (given or default_state_dir() / "operator.token").read_text(encoding="ascii").strip()
