"""A request is for this orchestrator only if it names it: see ``api.hosts``. The first thing that is looked at."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from urllib.parse import urlsplit

from starlette.requests import Request
from starlette.types import ASGIApp, Receive, Scope, Send

from skytether.api.hosts import is_own

from ..config.settings import Settings
from .problems import answer
from .refusal_delay import RefusalDelay

_SHOWN = 80
"""Characters of a strange name that are told."""


class TrustedHosts:
    """ASGI middleware: 421 for whoever asks somebody else."""

    def __init__(self, app: ASGIApp, names: tuple[str, ...], refusal_delay: RefusalDelay) -> None:
        """``names``: see ``own_names``; ``refusal_delay``: before it is refused."""
        self._app = app
        self._refusal_delay = refusal_delay
        self._names = names

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request. Without a Host, as of HTTP/1.0, it is of no browser."""
        strange = self._strange(scope)
        if strange is None:
            await self._app(scope, receive, send)
            return
        await self._refusal_delay.wait()
        text = (
            f"this orchestrator is not known as {strange[:_SHOWN]!r}: ask it by its address, or add the name to "
            "'hosts' in its configuration (SKYTETHER_HOSTS)"
        )
        plain = Request({**scope, "headers": []})  # what was sent as Host may be no part of any address
        await answer(plain, 421, "Misdirected request", text)(scope, receive, send)

    def _strange(self, scope: Scope) -> str | None:
        """As whom it is asked, if that is not us."""
        if scope["type"] != "http":
            return None
        hosts = (value.decode("latin-1") for name, value in scope["headers"] if name == b"host")
        return next((host for host in hosts if not is_own(host, self._names)), None)


def own_names(settings: Settings) -> tuple[str, ...]:
    """What an orchestrator is called: as it was told, and as its machine."""
    return tuple(name for name in _names(settings) if name)


def _names(settings: Settings) -> Iterator[str]:
    yield from settings.hosts
    yield settings.host
    if settings.advertise is not None:
        yield urlsplit(settings.advertise).hostname or ""
    machine = socket.gethostname()
    yield from (machine, machine.partition(".")[0], f"{machine.partition('.')[0]}.local")
