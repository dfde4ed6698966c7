"""``skytether site drain, resume, remove``: sites whose instances are moved elsewhere."""

from __future__ import annotations

import time
from collections.abc import Callable
from http import HTTPStatus
from typing import TYPE_CHECKING, Annotated

import typer

from ...connection import Json, TokenFile, Url, connected
from ...names import SiteName
from ...output import console, fail, plain, print_json

if TYPE_CHECKING:
    from skytether.api.client import Client
    from skytether.api.rest import Site

_POLL_S = 0.5
Patience = Annotated[
    float, typer.Option("--timeout-s", min=0, help="How long to wait for what runs there to be moved, or to end.")
]


def drain_site(
    name: SiteName,
    wait: Annotated[bool, typer.Option(help="Wait until nothing runs there any more.")] = True,
    timeout_s: Patience = 600.0,
    url: Url = None,
    token_file: TokenFile = None,
    json: Json = False,
) -> None:
    """Have a site take no more instances, and move those that are there: before it is updated, say.

    Each robot is handed over before the old instance ends. `skytether site resume` has the site take instances again.
    """
    with connected(url, token_file) as client:
        site = client.drain_site(name)
        if wait:
            advice = "; `skytether instance list` says why"
            site = _until(client, site, lambda now: _left(now) if now.instances else "", timeout_s, advice)
    if json:
        print_json(plain(site))
    else:
        console.print(f"site {name} takes no more instances; {site.instances} are there", markup=False)


def resume_site(
    name: SiteName,
    wait: Annotated[bool, typer.Option(help="Wait until instances can be started there.")] = True,
    timeout_s: Annotated[float, typer.Option("--timeout-s", min=0, help="How long to wait for that.")] = 300.0,
    url: Url = None,
    token_file: TokenFile = None,
    json: Json = False,
) -> None:
    """Have a site that was drained take instances again, and wait until it can: before the next one is drained.

    One that does not come back is told of, with status 1; it takes instances as soon as it does.
    """
    with connected(url, token_file) as client:
        site = client.resume_site(name)
        if wait:
            site = _until(client, site, _not_ready, timeout_s)
    if json:
        print_json(plain(site))
    else:
        console.print(f"site {name} takes instances again", markup=False)


def remove_site(
    name: SiteName,
    force: Annotated[
        bool,
        typer.Option("--force", help="At once, with all that is there: for a machine that is gone for good."),
    ] = False,
    wait: Annotated[bool, typer.Option(help="Wait until it is gone.")] = True,
    timeout_s: Patience = 600.0,
    url: Url = None,
    token_file: TokenFile = None,
) -> None:
    """Drain a site, and forget it with its last instance. The certificate of a machine that joined is no good then."""
    from skytether.api.client import ApiError

    with connected(url, token_file) as client:
        if force:
            client.delete_site(name, force=True)
        else:
            client.drain_site(name)
            gone = client.delete_site(name, drain=True)
            deadline, told = time.monotonic() + timeout_s, ""
            while wait and not gone:
                try:
                    left = _left(site) if (site := _get_site(client, name)) else "no orchestrator answers"
                except ApiError as error:
                    if error.problem.status != HTTPStatus.NOT_FOUND:
                        raise
                    break
                told = _print_new(left, told)
                if time.monotonic() >= deadline:
                    fail(f"{left}: site {name} goes with its last instance; with --force it goes now")
                time.sleep(_POLL_S)
            if not wait and not gone:
                console.print(f"site {name} goes when what runs there was moved, or has ended", markup=False)
                return
    console.print(f"site {name} is gone", markup=False)


def _left(site: Site) -> str:
    return f"{site.instances} instances are at site {site.name} still"


def _not_ready(site: Site) -> str:
    return "" if site.state == "ready" else f"site {site.name} is {site.state}: {site.reason}"


def _until(client: Client, site: Site, missing: Callable[[Site], str], timeout_s: float, advice: str = "") -> Site:
    """Wait for a site, and tell each change of what is missing.

    Args:
        client: The orchestrator.
        site: As it is now.
        missing: One sentence; empty: nothing.
        timeout_s: After that the command fails with the sentence.
        advice: After it then.
    """
    deadline, told = time.monotonic() + timeout_s, ""
    while text := missing(site):
        told = _print_new(text, told)
        if time.monotonic() >= deadline:
            fail(text + advice)
        time.sleep(_POLL_S)
        site = _get_site(client, site.name) or site
    return site


def _get_site(client: Client, name: str) -> Site | None:
    """A site as it is now; None: no orchestrator answers, as while it is updated.

    Raises:
        ApiError: There is no such site, or we may not see it.
    """
    from skytether.api.client import ApiError, Unreachable

    try:
        return client.get_site(name)
    except Unreachable:
        return None
    except ApiError as error:
        if error.problem.status != HTTPStatus.SERVICE_UNAVAILABLE:
            raise
        return None


def _print_new(text: str, told: str) -> str:
    if text != told:
        console.print(text, markup=False)
    return text
