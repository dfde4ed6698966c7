"""Ways to a Docker engine that a test can cut: a proxy of its socket, plain or TLS; an SSH server; a registry."""

from __future__ import annotations

import base64
import contextlib
import gzip
import hashlib
import io
import json
import os
import selectors
import socket
import ssl
import struct
import subprocess
import tarfile
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

ENGINE = "/var/run/docker.sock"
_PIECE = 65_536


class EngineProxy:
    """Passes bytes between clients and the engine's socket; ``cut`` is an engine that goes away."""

    def __init__(
        self, path: Path | None = None, context: ssl.SSLContext | None = None, target: str = f"unix://{ENGINE}"
    ) -> None:
        """On a socket of its own at ``path``, or on a TCP port of loopback with TLS; to the engine at ``target``."""
        self._target = target.removeprefix("unix://")
        self.swallow: bytes | None = None
        """Requests with this in them get lost on their way, and no answer; then ``swallowed`` is set."""
        self.swallowed = threading.Event()
        self.port = 0
        self._path = path
        self._context = context
        self._open: list[tuple[socket.socket, int]] = []
        """Connections, with the programs whose they are; 0: unknown."""
        self._shuts_out: Callable[[int], bool] = lambda _: False
        self._answers_all = True
        self._listener: socket.socket | None = None

    @property
    def engine(self) -> str:
        return f"unix://{self._path}" if self._path else f"tcp://127.0.0.1:{self.port}"

    def start(self) -> None:
        if self._path is not None:
            self._path.unlink(missing_ok=True)
            listener = socket.socket(socket.AF_UNIX)
            listener.bind(str(self._path))
            listener.listen()
        else:
            listener = socket.create_server(("127.0.0.1", self.port))
            self.port = listener.getsockname()[1]
        self._listener = listener
        threading.Thread(target=self._accept, args=(listener,), daemon=True).start()

    def cut(self) -> None:
        """Nobody listens any more, and who was connected is cut off."""
        if self._listener is not None:
            with contextlib.suppress(OSError):
                self._listener.shutdown(socket.SHUT_RDWR)
            self._listener.close()
            self._listener = None
        self._close(lambda _: True)

    def shut_out(self, whose: Callable[[int], bool], *, silently: bool = False) -> None:
        """Cut off those programs, by their ids; others are served as before. ``silently``: they get no answer."""
        self._shuts_out, self._answers_all = whose, not silently
        self._close(whose)

    def let_in(self) -> None:
        """Serve all of them again."""
        self._close(self._shuts_out)  # those that wait for an answer
        self._shuts_out = lambda _: False

    def _close(self, whose: Callable[[int], bool]) -> None:
        for one, program in list(self._open):
            if one.fileno() < 0:
                self._open.remove((one, program))
            elif whose(program):
                with contextlib.suppress(OSError):
                    one.shutdown(socket.SHUT_RDWR)  # its own thread closes it: else its number is another file's soon

    def _accept(self, listener: socket.socket) -> None:
        while True:
            try:
                client, _ = listener.accept()
            except OSError:
                return
            threading.Thread(target=self._serve, args=(client,), daemon=True).start()

    def _serve(self, client: socket.socket) -> None:
        program = _program(client)
        with client, socket.socket(socket.AF_UNIX) as engine, contextlib.suppress(OSError, ValueError):
            self._open.append((client, program))
            if self._shuts_out(program):
                while not self._answers_all and client.recv(_PIECE):
                    pass
                return
            self._open.append((engine, program))
            engine.connect(self._target)
            if self._context is None:
                self._pass_on(client, engine)
            else:
                with self._context.wrap_socket(client, server_side=True) as inner:
                    self._pass_on(inner, engine)

    def _pass_on(self, client: socket.socket, engine: socket.socket) -> None:
        """Both ways in one thread, until one of them ends: a TLS connection is not for two."""
        with selectors.DefaultSelector() as selector:
            selector.register(client, selectors.EVENT_READ)
            selector.register(engine, selectors.EVENT_READ)
            while True:
                pending = isinstance(client, ssl.SSLSocket) and client.pending()
                ready = [client] if pending else [key.fileobj for key, _ in selector.select()]
                if client in ready:
                    data = client.recv(_PIECE)
                    if not data:
                        return
                    if not self._loses(data):
                        engine.sendall(data)
                if engine in ready:
                    data = engine.recv(_PIECE)
                    if not data:
                        return
                    client.sendall(data)

    def _loses(self, data: bytes) -> bool:
        lost = self.swallow is not None and self.swallow in data
        if lost:
            self.swallowed.set()
        return lost


def _program(client: socket.socket) -> int:
    """Whose end the other one is."""
    if client.family != socket.AF_UNIX:
        return 0
    told = client.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
    return int(struct.unpack("3i", told)[0])


@contextmanager
def ssh_server(program: str) -> Iterator[dict[str, Any]]:
    """An SSH server of our own on loopback; gives a site's options for the engine behind it.

    ``program``: sshd, by its full path: it insists on that."""
    Path("/run/sshd").mkdir(mode=0o755, exist_ok=True)  # where it locks itself up
    with tempfile.TemporaryDirectory(prefix="skytether-sshd-") as name, socket.create_server(("127.0.0.1", 0)) as probe:
        folder = Path(name)
        port = probe.getsockname()[1]
        probe.close()
        for key in ("host", "user"):
            command = ["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(folder / key)]
            subprocess.run(command, check=True)
        (folder / "known").write_text(f"[127.0.0.1]:{port} {(folder / 'host.pub').read_text()}")
        settings = {
            "Port": port,
            "ListenAddress": "127.0.0.1",
            "HostKey": folder / "host",
            "AuthorizedKeysFile": folder / "user.pub",
            "PidFile": "none",
            "StrictModes": "no",
            "UsePAM": "no",
            "PasswordAuthentication": "no",
        }
        (folder / "config").write_text("".join(f"{key} {value}\n" for key, value in settings.items()))
        server = subprocess.Popen([program, "-D", "-e", "-f", str(folder / "config")], stderr=subprocess.DEVNULL)
        try:
            _until_listening(port, server)
            yield {
                "engine": f"ssh://127.0.0.1:{port}",
                "ssh": {"identity": str(folder / "user"), "known_hosts": str(folder / "known")},
            }
        finally:
            server.terminate()
            server.wait(30)


def _until_listening(port: int, server: subprocess.Popen[bytes]) -> None:
    deadline = time.monotonic() + 30
    while True:
        assert server.poll() is None, "the SSH server ended"
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=1):
            return
        assert time.monotonic() < deadline, "the SSH server does not answer"
        time.sleep(0.02)


class Registry:
    """A registry with one image, ``private/thing:1``, for those who know the password; it takes its time."""

    PASSWORD = "sesame"

    def __init__(self) -> None:
        self.server = ThreadingHTTPServer(("127.0.0.1", 0), self._handler())
        self.host = f"127.0.0.1:{self.server.server_address[1]}"
        layer = _layer(os.urandom(3 << 20))
        config = {
            "architecture": "amd64",
            "os": "linux",
            "config": {"Entrypoint": ["/nothing"]},
            "rootfs": {"type": "layers", "diff_ids": [_digest(gzip.decompress(layer))]},
        }
        blobs = [json.dumps(config).encode(), layer]
        kind = "application/vnd.docker."
        kinds = [f"{kind}container.image.v1+json", f"{kind}image.rootfs.diff.tar.gzip"]
        rows = [{"mediaType": k, "size": len(b), "digest": _digest(b)} for k, b in zip(kinds, blobs, strict=True)]
        self.kind = f"{kind}distribution.manifest.v2+json"
        manifest = {"schemaVersion": 2, "mediaType": self.kind, "config": rows[0], "layers": rows[1:]}
        self.manifest = json.dumps(manifest).encode()
        self.digest = _digest(self.manifest)
        self.blobs = {_digest(blob): blob for blob in blobs}
        threading.Thread(target=self.server.serve_forever, daemon=True).start()

    @property
    def image(self) -> str:
        return f"{self.host}/private/thing"

    def credentials(self, folder: Path, password: str = PASSWORD) -> str:
        """A file of credentials, as ``docker login`` writes it."""
        path = folder / "config.json"
        path.touch(0o600)
        auth = base64.b64encode(f"robot:{password}".encode()).decode()
        path.write_text(json.dumps({"auths": {self.host: {"auth": auth}}}))
        return str(path)

    def close(self) -> None:
        self.server.shutdown()
        self.server.server_close()

    def _handler(registry) -> type[BaseHTTPRequestHandler]:  # noqa: N805 (self is the handler's)
        wanted = "Basic " + base64.b64encode(f"robot:{Registry.PASSWORD}".encode()).decode()

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                if self.headers.get("Authorization") != wanted:
                    self._answer(401, b'{"errors": [{"code": "UNAUTHORIZED"}]}', {"WWW-Authenticate": "Basic realm=x"})
                    return
                last = self.path.rpartition("/")[2]
                if "/manifests/" in self.path and last in ("1", registry.digest):
                    self._answer(200, registry.manifest, {"Docker-Content-Digest": registry.digest}, registry.kind)
                elif last in registry.blobs:
                    self._answer(200, registry.blobs[last], {})
                else:
                    self._answer(200 if self.path == "/v2/" else 404, b"{}", {})

            def do_HEAD(self) -> None:
                self.do_GET()

            def _answer(
                self, status: int, body: bytes, headers: dict[str, str], kind: str = "application/json"
            ) -> None:
                self.send_response(status)
                for key, value in {**headers, "Content-Type": kind, "Content-Length": str(len(body))}.items():
                    self.send_header(key, value)
                self.end_headers()
                if self.command == "HEAD":
                    return
                for begin in range(0, len(body), 1 << 18):
                    self.wfile.write(body[begin : begin + (1 << 18)])
                    self.wfile.flush()
                    time.sleep(0.1 if len(body) > 1 << 18 else 0)

            def log_message(self, *_: Any) -> None:
                pass

        return Handler


def _layer(content: bytes) -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:gz") as tar:
        entry = tarfile.TarInfo("content")
        entry.size = len(content)
        tar.addfile(entry, io.BytesIO(content))
    return buffer.getvalue()


def _digest(content: bytes) -> str:
    return f"sha256:{hashlib.sha256(content).hexdigest()}"
