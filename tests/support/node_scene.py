"""An orchestrator with its door for nodes, machines that join it, and engines that are made up."""

from __future__ import annotations

import asyncio
import contextlib
import json
import platform
import socket
import socketserver
import ssl
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any

from typing_extensions import override

from skytether.api.manifest import Strict
from skytether.api.node import SERVER_NAME, Link, Linked, line_of
from skytether.node.calls import trusting
from skytether.node.join import Joined, JoinOptions, join
from skytether.node.run import NodeProgram
from skytether.node.store import NodeStore
from skytether.orchestrator.core import Orchestrator
from skytether.orchestrator.http.node_serving import serving_nodes
from skytether.orchestrator.http.server import listening
from skytether.orchestrator.runtimes.base import Capacity, Observation, Runtime
from skytether.orchestrator.runtimes.docker.engine import Engine
from skytether.orchestrator.runtimes.docker.options import DockerOptions
from skytether.testing.runtimes import FakeOptions, FakeRuntime, FakeWorld

PATIENCE = 30.0


def until(condition: Callable[[], Any], patience: float = PATIENCE) -> Any:
    """Wait for it; what it gave."""
    deadline = time.monotonic() + patience
    while not (found := condition()):
        assert time.monotonic() < deadline
        time.sleep(0.01)
    return found


class MadeUpEngine:
    """Says what it is, on a socket, and can be away; nothing runs there."""

    def __init__(self, path: Path, **changes: Any) -> None:
        self.path = path
        self.info = {
            "Architecture": platform.machine(),
            "NCPU": 8,
            "MemTotal": 16 << 30,
            "DockerRootDir": "/",
            "SystemTime": "2026-11-26T00:00:00.0Z",
            **changes,
        }
        self.version = {"Version": "29.1", "ApiVersion": changes.pop("ApiVersion", "1.52")}
        self.asked = 0
        self.containers: list[Any] = []
        self._server: socketserver.ThreadingUnixStreamServer | None = None
        self.start()

    def start(self) -> None:
        engine = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def do_GET(self) -> None:
                engine.asked += 1
                place = self.path.partition("?")[0].rpartition("/")[2]
                found = {
                    "version": engine.version,
                    "info": engine.info,
                    "volumes": {"Volumes": []},
                    "json": engine.containers,
                }
                with contextlib.suppress(ConnectionError):
                    if place in found:
                        self._say(200, found[place])
                    elif place == "events":
                        time.sleep(1.0)  # none, for a while
                        self._say(200, [])
                    else:
                        self._say(404, {"message": f"there is no {self.path} here"})

            def do_POST(self) -> None:
                self.rfile.read(int(self.headers.get("Content-Length", 0)))
                with contextlib.suppress(ConnectionError):
                    self._say(201, {"Name": "made up"})

            def do_DELETE(self) -> None:
                with contextlib.suppress(ConnectionError):
                    self._say(404, {"message": "there is nothing here"})

            def _say(self, status: int, document: Any) -> None:
                body = json.dumps(document).encode()
                self.send_response(status)
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, *_: Any) -> None:
                pass

            def address_string(self) -> str:
                return "engine"

        class Server(socketserver.ThreadingUnixStreamServer):
            daemon_threads = True
            request_queue_size = 64

        self.path.unlink(missing_ok=True)
        self._server = Server(str(self.path), Handler)
        threading.Thread(target=self._server.serve_forever, args=(0.02,), daemon=True).start()

    def stop(self) -> None:
        if self._server is not None:
            self._server.shutdown()
            self._server.server_close()
            self._server = None
        self.path.unlink(missing_ok=True)


class ReachedRuntime(FakeRuntime):
    """Asks the engine of its site whether it is there, as a Docker site would; what runs there is made up."""

    Options = DockerOptions  # type: ignore[assignment]
    owner_options = frozenset({"network"})
    worlds: dict[str, FakeWorld] = {}
    """What runs at a site, whoever opened it; emptied by each scene."""

    @override
    def __init__(self, site: str, folder: Path, options: Strict) -> None:
        assert isinstance(options, DockerOptions)
        super().__init__(site, folder, FakeOptions(), self.worlds.setdefault(site, FakeWorld()))
        self.host = options.advertised
        self.engine = Engine(options, folder)

    def _ask(self) -> Any:
        with self.engine.asked():
            return self.engine.api().info()

    @override
    def capacity(self) -> Capacity:
        info = self._ask()
        return Capacity(info["NCPU"], info["MemTotal"] >> 20, architecture="amd64")

    @override
    def observe(self) -> dict[str, Observation]:
        self._ask()
        return dict(super().observe())

    @override
    def close(self) -> None:
        self.engine.drop()


def find_runtime(name: str) -> type[Runtime]:
    return ReachedRuntime if name == "docker" else FakeRuntime


class NodeScene:
    """One orchestrator, and the machines that join it."""

    def __init__(self, core: Orchestrator, operator: Any, folder: Path, api: str = "") -> None:
        self.core = core
        self.operator, self.api = operator, api
        self.folder = folder
        self.sockets = Path(tempfile.mkdtemp(prefix="sky-"))
        """Short paths."""
        self._stack = contextlib.ExitStack()
        self._door = contextlib.ExitStack()
        self.url = ""
        self.port = 0
        self.open()

    def open(self) -> None:
        """Begin to serve nodes, or begin anew."""
        listener = self._door.enter_context(listening("127.0.0.1", self.port))
        self.port = listener.getsockname()[1]
        self.url = f"https://127.0.0.1:{self.port}"
        self._door.enter_context(serving_nodes(self.core, listener))

    def shut(self) -> None:
        """No node reaches the orchestrator any more."""
        self._door.close()

    def close(self) -> None:
        self._stack.close()
        self._door.close()

    def engine(self, name: str = "edge", **changes: Any) -> MadeUpEngine:
        engine = MadeUpEngine(self.sockets / f"{name}.sock", **changes)
        self._stack.callback(engine.stop)
        return engine

    def store(self, name: str = "edge") -> NodeStore:
        return NodeStore(self.folder / f"node-{name}")

    def invite(self, name: str = "edge", **changes: Any) -> str:
        from skytether.api.rest import Invite

        return str(self.operator.invite(Invite(name=name, **changes)).token)

    def options(self, token: str, name: str = "edge", **changes: Any) -> JoinOptions:
        given = {
            "urls": (self.url,),
            "engine": f"unix://{self.sockets}/{name}.sock",
            "folder": self.store(name).folder,
            "unit": False,
            "echo": None,
            "advertise": "127.0.0.1",
            **changes,
        }
        return JoinOptions(token=token, **given)

    def join(self, name: str = "edge", **changes: Any) -> Joined:
        if not (self.sockets / f"{name}.sock").exists():
            self.engine(name)
        return join(self.options(self.invite(name), name, **changes))

    @contextmanager
    def running(self, name: str = "edge") -> Iterator[list[str]]:
        """The node's program; gives the addresses that it linked with, as they come."""
        with program(self.store(name)) as linked:
            yield linked

    def state(self, name: str = "edge") -> str:
        return str(self.operator.get_site(name).state)


@contextmanager
def program(store: NodeStore) -> Iterator[list[str]]:
    linked: list[str] = []
    node, loop = NodeProgram(store, linked.append), asyncio.new_event_loop()
    task = loop.create_task(node.run())

    def run() -> None:
        with contextlib.suppress(asyncio.CancelledError):
            loop.run_until_complete(task)
        loop.run_until_complete(loop.shutdown_default_executor())
        loop.close()

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield linked
    finally:
        loop.call_soon_threadsafe(task.cancel)
        thread.join()


def context_of(store: NodeStore) -> ssl.SSLContext:
    return trusting(store.authority(), store.identity)


@contextmanager
def connection(nodes: NodeScene, context: ssl.SSLContext) -> Iterator[ssl.SSLSocket]:
    plain = socket.create_connection(("127.0.0.1", nodes.port), timeout=10)
    with plain, context.wrap_socket(plain, server_hostname=SERVER_NAME) as link:
        yield link


def first_line(link: ssl.SSLSocket) -> bytes:
    """Empty: it was ended without a word."""
    line = b""
    with contextlib.suppress(OSError):
        while not line.endswith(b"\n") and (piece := link.recv(4096)):
            line += piece
    return line


def linked_by(link: ssl.SSLSocket) -> str:
    """Begin a node's link by a connection; what its ways have to show."""
    link.sendall(line_of(Link()))
    return Linked.model_validate_json(first_line(link).splitlines()[0]).link
