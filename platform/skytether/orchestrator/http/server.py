"""One orchestrator as a program: lock, listen, serve, shut down in order."""

from __future__ import annotations

import fcntl
import gc
import logging
import math
import os
import resource
import signal
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import uvicorn
from alembic.util import CommandError
from sqlalchemy.exc import DatabaseError, SQLAlchemyError

from skytether.api.plain_http import is_loopback
from skytether.bridge.echo import EchoServer

from ..config.settings import Settings
from ..core import Orchestrator
from ..domain.errors import InvalidError, OutdatedError
from ..domain.security import SecretFileError
from ..store.engine import AddressError
from ..telemetry import logs
from .app import create_app
from .certificate import LiveCertificate
from .connections import Acceptor, GuardedProtocol
from .node_serving import serving_nodes

log = logging.getLogger(__name__)

_DRAIN = 5
"""Whole seconds that requests under way get at shutdown."""
_CERTIFICATE_TICKS = 20
"""Tenths of a second between two looks whether the certificate was renewed."""
_BACKLOG = 512
_FILES = 16_384
"""Open files, connections among them; beyond that nobody could be served in time."""
_SWITCH = 0.00005
"""Seconds that one thread computes while others wait. A renewal passes through several threads, and waits so long at
each of some ten calls of the database while the loop is busy: with 1 ms, 99 of 100 took up to 81 ms beside a hostile
robot, with 0.2 ms 60, with this 40 (`skytether lab bench hostile`), and as much else was served."""
_COLLECTED = (700, 10, 100)
"""When garbage is looked for (`gc.set_threshold`): Python's own, but a tenth as often among what is old, which holds up
everybody for 20 to 100 ms. What a connection or a refusal leaves is no such garbage, so little comes together."""


class StartError(Exception):
    """It cannot start; one sentence saying what to do."""

    def __init__(self, text: str, *, usage: bool = False) -> None:
        """``usage``: what it was given is wrong, rather than the state of the machine."""
        super().__init__(text)
        self.usage = usage


def run(settings: Settings) -> None:
    """Serve until SIGTERM or SIGINT.

    The real address is written to ``address`` in the state folder once requests are answered, and removed at the end.

    Raises:
        StartError: The state folder is in use, the port is taken, or a file is wrong.
    """
    try:
        settings.state_dir.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise StartError(f"cannot make {settings.state_dir}: {error.strerror}; give another --state-dir") from error
    try:
        logs.set_up(settings.logs)
    except OSError as error:
        where = error.filename or settings.logs.audit_file
        raise StartError(f"cannot write the audit to {where}: {error.strerror}", usage=True) from error
    _allow_connections()
    with (
        _locked(settings.state_dir),
        listening(settings.host, settings.port) as listener,
        _listening_for_nodes(settings) as for_nodes,
    ):
        _check_secrecy(settings, listener)
        try:
            core = Orchestrator(settings)
        except SecretFileError as error:
            raise StartError(str(error)) from error
        except AddressError as error:
            raise StartError(str(error), usage=True) from error
        _serve(core, listener, for_nodes)


@contextmanager
def _listening_for_nodes(settings: Settings) -> Iterator[socket.socket | None]:
    if settings.nodes.port is None:
        yield None
        return
    with listening(settings.nodes.host or settings.host, settings.nodes.port, "nodes.") as listener:
        yield listener


def _check_secrecy(settings: Settings, listener: socket.socket) -> None:
    host = listener.getsockname()[0]
    if settings.tls.certificate or settings.insecure_http or is_loopback(host):
        return
    raise StartError(
        f"without TLS, tokens and keys of sessions could be read on the way to {host}: give a certificate "
        "(tls.certificate, tls.key), or listen on 127.0.0.1 behind a proxy that has one; inside a network that is all "
        "yours (a VPN, a bridge of containers) allow it with --insecure-http",
        usage=True,
    )


def _allow_connections() -> None:
    """As many as the system lets this program have: a thousand robots may come at once."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    enough = _FILES if hard == resource.RLIM_INFINITY else min(_FILES, hard)
    if resource.RLIM_INFINITY != soft < enough:
        resource.setrlimit(resource.RLIMIT_NOFILE, (enough, hard))


def _serve(core: Orchestrator, listener: socket.socket, for_nodes: socket.socket | None) -> None:
    server = _Server(core, listener)
    # Uvicorn handles signals while it serves, and raises them again when it has ended; ours are for before and after.
    previous = {number: signal.signal(number, server.handle_exit) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        _start(core)
        try:
            gc.freeze()  # what is loaded by now stays: looking through it for garbage holds up every request
            gc.set_threshold(*_COLLECTED)
            sys.setswitchinterval(_SWITCH)
            with _echo(core, listener), serving_nodes(core, for_nodes):
                server.run(sockets=[listener])
        finally:
            core.stop()
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


@contextmanager
def _echo(core: Orchestrator, listener: socket.socket) -> Iterator[None]:
    """Answer UDP echoes at the same address and number; where that is taken, do without."""
    host, port = listener.getsockname()[:2]
    if not core.settings.echo:
        yield
        return
    try:
        server = EchoServer(host, port)
    except OSError as error:
        log.warning("no UDP echo on %s port %d: %s", host, port, error.strerror)
        yield
        return
    with server:
        yield


def _start(core: Orchestrator) -> None:
    try:
        core.start()
    except InvalidError as error:
        raise StartError(str(error), usage=True) from error
    except SecretFileError as error:
        raise StartError(str(error)) from error
    except OutdatedError as error:
        raise StartError(str(error)) from error
    except (SQLAlchemyError, CommandError) as error:
        text = str(getattr(error, "orig", None) or error).splitlines()[0]
        file = core.settings.state_dir / "state.db"
        if core.settings.database_url is None and isinstance(error, DatabaseError) and "not a database" in text:
            advice = "restore a backup (`skytether orchestrator restore`), or give another --state-dir"
            raise StartError(f"{file} is no database: {advice}") from error
        raise StartError(f"the database cannot be used: {text}") from error


class _Server(uvicorn.Server):
    """Uvicorn that tells its address, and lets event streams end when it is to end."""

    def __init__(self, core: Orchestrator, listener: socket.socket) -> None:
        tls = core.settings.tls
        config = uvicorn.Config(
            create_app(core),
            http=GuardedProtocol,
            ws="none",
            timeout_keep_alive=math.ceil(core.settings.limits.idle_s),
            log_config=None,
            access_log=False,
            lifespan="off",
            server_header=False,
            timeout_graceful_shutdown=_DRAIN,
            proxy_headers=bool(core.settings.proxies),
            forwarded_allow_ips=list(core.settings.proxies),
        )
        super().__init__(config)
        self._certificate: LiveCertificate | None = None
        if tls.certificate and tls.key:
            try:
                self._certificate = LiveCertificate(tls.certificate, tls.key)
            except SecretFileError as error:
                raise StartError(str(error), usage=True) from error
        self._core = core
        self._address = core.settings.state_dir / "address"
        host, port = listener.getsockname()[:2]
        scheme = "https" if tls.certificate else "http"
        self._url = f"{scheme}://[{host}]:{port}" if ":" in host else f"{scheme}://{host}:{port}"

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Uvicorn's own would take every connection; the rest of it is for lifespans and several workers."""
        limits, proxies = self._core.settings.limits, self._core.settings.proxies
        most = min(limits.connections, resource.getrlimit(resource.RLIMIT_NOFILE)[0] // 2)
        make = partial(GuardedProtocol, config=self.config, server_state=self.server_state, app_state={})
        overload = self._core.overload
        acceptors: list[Any] = [
            Acceptor(one, make, self._certificate, limits, most, proxies, overload) for one in sockets or ()
        ]
        self.servers = acceptors
        self.started = True
        draft = self._address.with_name("address.new")
        draft.write_text(f"{self._url}\n")
        draft.replace(self._address)
        log.info("listening on %s, state in %s", self._url, self._core.settings.state_dir)

    async def on_tick(self, counter: int) -> bool:
        if self._certificate is not None and counter % _CERTIFICATE_TICKS == 0:
            self._certificate.reload()
        return await super().on_tick(counter)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        self._address.unlink(missing_ok=True)
        self._core.broker.close()
        await super().shutdown(sockets)
        self._core.overload.rest()


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Keep a second orchestrator out; the kernel lets go of the lock however this one ends."""
    try:
        file = (folder / "lock").open("a+")
    except OSError as error:
        raise StartError(f"cannot write to {folder}: {error.strerror}; give another --state-dir") from error
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            who = file.read().strip() or "unknown"
            text = f"another orchestrator (pid {who}) uses {folder}: stop it, or give another folder with --state-dir"
            raise StartError(text) from None
        file.truncate(0)
        file.write(str(os.getpid()))
        file.flush()
        yield


@contextmanager
def listening(host: str, port: int, group: str = "") -> Iterator[socket.socket]:
    """A socket that listens; ``group``: of the settings that say where, with a dot; none: options say it too.

    Raises:
        StartError: There is no such address, or the port is taken.
    """
    try:
        # The protocol is named: asyncio turns Nagle's delay (40 ms an answer) off only for sockets that say TCP.
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listener = socket.socket(family, kind, protocol)
    except OSError as error:
        other = f"give another with {_options(group, 'host')}"
        raise StartError(f"there is no address '{host}' here: {error.strerror}; {other}") from error
    with listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind(address)
            listener.listen(_BACKLOG)
        except OSError as error:
            other = f"give another with {_options(group, 'host')} or {_options(group, 'port')}"
            raise StartError(f"cannot listen on {host} port {port}: {error.strerror}; {other}") from error
        yield listener


def _options(group: str, key: str) -> str:
    return f"{group}{key}" if group else f"--{key}"
