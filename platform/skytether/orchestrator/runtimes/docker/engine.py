"""The way to an engine, and its errors as ours. Every call has a time-out."""

from __future__ import annotations

import errno
import logging
import os
import shlex
import shutil
import socket
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import requests
import urllib3
from docker import APIClient
from docker.errors import APIError, DockerException
from docker.tls import TLSConfig

from skytether.guard.folder import objection_to

from ..base import ENGINE_AWAY, ENGINE_SOCKET, RuntimeFailure, SiteSilentError
from .client import Client
from .options import LOCAL_SOCKET, DockerOptions

log = logging.getLogger(__name__)

_POOL = 32
"""Connections that are kept: as many calls may be under way at once."""
_OLDEST = "1.41"
"""Version of the engine's interface with which its newest is asked for: Docker 20.10's."""
_PROBE_S = 5.0
"""An engine that is stopped lets its queue of connections fill up; then even this takes time."""
_MOST_WORDS = 2000
"""Characters of what an engine says is wrong: they are kept, logged and told."""
_SSH_TIMEOUT = 15
"""Seconds that SSH gets to connect, and after which a silent connection is given up."""


class EngineGoneError(SiteSilentError):
    """The engine does not answer: nothing is known of what runs there."""


class Engine:
    """One engine; connects at the first call, and anew after :meth:`drop`."""

    def __init__(self, options: DockerOptions, folder: Path | None = None) -> None:
        """``folder``: the site's own, where the socket of a joined node is."""
        self._options = options
        self._lock = threading.Lock()
        self._tunnel: Tunnel | NodeSocket | None = None
        if options.address.scheme == "ssh":
            self._tunnel = Tunnel(options)
        elif options.address.scheme == "node":
            self._tunnel = NodeSocket(options, folder or Path())
        self._clients: dict[float, APIClient] = {}

    def api(self, timeout_s: float | None = None) -> APIClient:
        """A client whose calls, and the gaps in whose streams, take at most ``timeout_s`` [s]; the site's by default.

        Raises:
            EngineGoneError: The engine cannot be reached.
        """
        timeout = timeout_s or self._options.timeout_s
        with self._lock:
            with self.asked():
                if self._tunnel is not None:
                    _probe(str(self._tunnel.open()))
                elif self._options.local:
                    _probe(self._options.address.path)
            if timeout not in self._clients:
                with self.asked():
                    self._clients[timeout] = self._connect(timeout)
            return self._clients[timeout]

    def _connect(self, timeout: float) -> APIClient:
        address, tls = self._options.engine, self._options.tls
        arguments: dict[str, Any] = {"timeout": timeout, "max_pool_size": _POOL}
        if self._tunnel is not None:
            address = f"unix://{self._tunnel.open()}"
        if tls is not None:
            pair = (tls.cert, tls.key)
            arguments["tls"] = TLSConfig(client_cert=pair, ca_cert=tls.ca, verify=True)
            address = address.replace("tcp://", "https://", 1)
        known = next(iter(self._clients.values()), None)
        if known is not None:  # nobody waits for the engine, with the lock, to hear the same again
            return Client(address, version=known.api_version, **arguments)
        with closing(Client(address, version=_OLDEST, **arguments)) as first:
            version = str(first.version(api_version=False)["ApiVersion"])
        return Client(address, version=version, **arguments)

    def drop(self) -> None:
        """Let go of all connections; the next call makes new ones."""
        with self._lock:
            clients, self._clients = list(self._clients.values()), {}
            if self._tunnel is not None:
                self._tunnel.close()
        for client in clients:
            client.close()

    @contextmanager
    def asked(self) -> Iterator[None]:
        """Around calls: what the SDK raises, as ours.

        Raises:
            EngineGoneError: The engine does not answer.
            RuntimeFailure: It refused, in its own words; or what it answers is of another shape than an engine's.
        """
        try:
            yield
        except RuntimeFailure:
            raise
        except APIError as error:
            raise RuntimeFailure(explain(error)) from error
        except (requests.RequestException, urllib3.exceptions.HTTPError, DockerException, OSError) as error:
            raise EngineGoneError(
                f"the Docker engine at {self._options.engine} does not answer: {root_cause(error)}"
            ) from error
        except (KeyError, IndexError, TypeError, AttributeError, ValueError) as error:
            log.debug("an engine's answer is not understood", exc_info=True)
            raise RuntimeFailure(f"the Docker engine's answer is not understood: {root_cause(error)}") from error


def _probe(path: str) -> None:
    """See whether anybody listens on a socket: the SDK leaves one open that does not connect.

    Raises:
        OSError: Nobody does, or somebody who may not: an engine has all that runs there, and grants of instances.
    """
    with socket.socket(socket.AF_UNIX) as probe:
        probe.settimeout(_PROBE_S)
        probe.connect(path)
        if why := objection_to(probe, path):
            raise PermissionError(errno.EPERM, f"whoever listens at {path} may not be the engine: {why}")


def explain(error: APIError) -> str:
    """What the engine said, in so many words."""
    return str(error.explanation or error)[:_MOST_WORDS].strip().rstrip(".")


def status_of(error: BaseException) -> int | None:
    """The HTTP status with which an engine refused; None: it did not."""
    return error.status_code if isinstance(error, APIError) else None


def root_cause(error: BaseException) -> str:
    """The innermost reason, without the wrapping of four libraries."""
    seen: set[int] = set()
    while id(error) not in seen:
        seen.add(id(error))
        inner = [a for a in (getattr(error, "reason", None), *error.args, error.__cause__, error.__context__) if a]
        error = next((a for a in inner if isinstance(a, BaseException)), error)
    if isinstance(error, TimeoutError):
        return "timed out"
    return str(getattr(error, "strerror", None) or error or type(error).__name__)[:_MOST_WORDS].strip()


class NodeSocket:
    """The way to the engine of a node that joined: a socket in the site's folder, there while the node is linked."""

    def __init__(self, options: DockerOptions, folder: Path) -> None:
        self._name = options.address.hostname
        self._folder = folder
        self._file: int | None = None

    def open(self) -> Path:
        """Where it is: by the folder's open file, for a socket's path has 107 bytes at most, and a state folder's more.

        Raises:
            OSError: The node is not linked, or its engine is away; with what is known.
        """
        if not (self._folder / ENGINE_SOCKET).exists():
            try:
                why = (self._folder / ENGINE_AWAY).read_text()
            except OSError:
                why = "it has not called since this orchestrator was started"
            raise OSError(f"node '{self._name}' is not linked ({why}); see `systemctl status skytether-node` there")
        if self._file is None:
            self._file = os.open(self._folder, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
        return Path(f"/proc/self/fd/{self._file}/{ENGINE_SOCKET}")

    def close(self) -> None:
        """Forget the path."""
        if self._file is not None:
            os.close(self._file)
            self._file = None


class Tunnel:
    """An SSH client that makes an engine's socket one of ours.

    It runs ``cat`` there, which ends with our end of its input: no tunnel outlives the orchestrator, however that ends.

    docker-py has two ways of its own. By the ``ssh`` program it starts one for each connection, wants Docker's command
    line over there, takes no option (whose host keys are believed, which identity, keepalives), and waits without end
    for an engine that is silent, since a pipe has no timeout. By paramiko the user's SSH configuration counts in part.
    """

    def __init__(self, options: DockerOptions) -> None:
        self._options = options
        self._folder: Path | None = None
        self._process: subprocess.Popen[bytes] | None = None

    def command(self, here: Path, said: Path) -> list[str]:
        """What is run; what it has to say itself goes into a file, and nothing that the other machine sends."""
        address, ssh = self._options.address, self._options.ssh
        settings = {
            "BatchMode": "yes",  # nobody is there to answer a question
            # Whatever the user's configuration says: an engine's machine that is not known is nobody's.
            "StrictHostKeyChecking": "yes",
            "VerifyHostKeyDNS": "no",
            "NoHostAuthenticationForLocalhost": "no",
            "UpdateHostKeys": "no",
            "ForwardAgent": "no",
            "ConnectTimeout": str(_SSH_TIMEOUT),
            "ExitOnForwardFailure": "yes",
            "ServerAliveInterval": "5",
            "ServerAliveCountMax": "3",
        }
        if ssh.known_hosts is not None:
            settings["UserKnownHostsFile"] = shlex.quote(ssh.known_hosts)
            settings["GlobalKnownHostsFile"] = "/dev/null"  # this file says who it is, and no other
        command = ["ssh", "-T", "-E", str(said)]
        for key, value in settings.items():
            command += ["-o", f"{key}={value}"]
        if ssh.identity is not None:
            command += ["-i", ssh.identity, "-o", "IdentitiesOnly=yes"]
        if address.port is not None:
            command += ["-p", str(address.port)]
        host = f"{address.username}@{address.hostname}" if address.username else str(address.hostname)
        remote = address.path if address.path not in ("", "/") else LOCAL_SOCKET
        return [*command, "-L", f"{here}:{remote}", host, "cat"]

    def open(self) -> Path:
        """Where the engine is now; the client is started unless it runs.

        Raises:
            OSError: No connection; with what the client said.
        """
        if self._folder is None:
            # A short path: a socket's has 107 bytes at most, and a state folder's may be longer.
            self._folder = Path(tempfile.mkdtemp(prefix="skytether-"))
        here, said = self._folder / "engine.sock", self._folder / "said"
        if self._process is not None and self._process.poll() is None and here.exists():
            return here
        self._end()
        here.unlink(missing_ok=True)  # always the same path: clients that are made stay good
        if shutil.which("ssh") is None:
            raise OSError("the program 'ssh' is missing: install openssh-client")
        said.unlink(missing_ok=True)
        none = subprocess.DEVNULL  # what is sent from there could fill the disk
        self._process = subprocess.Popen(self.command(here, said), stdin=subprocess.PIPE, stdout=none, stderr=none)
        deadline = time.monotonic() + _SSH_TIMEOUT
        while not here.exists():
            if self._process.poll() is not None or time.monotonic() > deadline:
                text = said.read_text(errors="replace") if said.exists() else ""
                lines = [line for line in text.splitlines() if line.strip()]
                self._end()
                raise OSError(f"ssh: {lines[-1].strip() if lines else 'no connection'}")
            time.sleep(0.01)
        return here

    def close(self) -> None:
        """End the client, and forget the path."""
        self._end()
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._folder = None

    def _end(self) -> None:
        if self._process is not None:
            self._process.terminate()
            try:
                self._process.wait(2)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
            if self._process.stdin is not None:
                self._process.stdin.close()
            self._process = None
