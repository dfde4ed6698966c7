"""A real registry of images (Debian's docker-registry) on loopback, with no login, passwords or tokens."""

from __future__ import annotations

import base64
import json
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from urllib.parse import parse_qs, urlsplit

import httpx
import yaml
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import padding, rsa

USER, PASSWORD = "robot", "sesame"
_HTPASSWD = f"{USER}:$2b$04$xLv5NHVmdR5hoMACRfl.MuUvv0zryAMhP5AbaVxV3eJPsrKj6DoVe\n"


@contextmanager
def registry(program: str, folder: Path, auth: dict[str, object] | None = None) -> Iterator[str]:
    """A registry's ``HOST:PORT``; it keeps its images below ``folder``."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        host = f"127.0.0.1:{free.getsockname()[1]}"
    settings: dict[str, object] = {
        "version": "0.1",
        "log": {"level": "warn", "accesslog": {"disabled": True}},
        "storage": {"filesystem": {"rootdirectory": str(folder / "store")}},
        "http": {"addr": host, "secret": "of a test"},
    }
    (folder / "registry.yml").write_text(yaml.safe_dump(settings | ({"auth": auth} if auth else {})))
    with (folder / "registry.log").open("wb") as log:
        server = subprocess.Popen([program, "serve", str(folder / "registry.yml")], stdout=log, stderr=log)
    try:
        deadline = time.monotonic() + 30
        while True:
            assert server.poll() is None, (folder / "registry.log").read_text()
            try:
                httpx.get(f"http://{host}/v2/", trust_env=False)
                break
            except httpx.HTTPError:
                assert time.monotonic() < deadline, (folder / "registry.log").read_text()
                time.sleep(0.02)
        yield host
    finally:
        server.terminate()
        server.wait()


def passwords(folder: Path) -> dict[str, object]:
    """Settings of a registry that asks for a password itself."""
    (folder / "htpasswd").write_text(_HTPASSWD)
    return {"htpasswd": {"realm": "test", "path": str(folder / "htpasswd")}}


@contextmanager
def token_server(folder: Path) -> Iterator[dict[str, object]]:
    """Settings of a registry that sends for a token, and who gives these to whoever knows the password."""
    key = rsa.generate_private_key(public_exponent=65537, key_size=2048)
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "tokens")])
    now = datetime.now(UTC)
    certificate = (
        x509.CertificateBuilder(name, name, key.public_key(), x509.random_serial_number())
        .not_valid_before(now - timedelta(hours=1))
        .not_valid_after(now + timedelta(hours=1))
        .sign(key, hashes.SHA256())
    )
    (folder / "tokens.pem").write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
    chain = base64.b64encode(certificate.public_bytes(serialization.Encoding.DER)).decode()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            wanted = "Basic " + base64.b64encode(f"{USER}:{PASSWORD}".encode()).decode()
            self._give(parse_qs(urlsplit(self.path).query)["scope"][0], self.headers.get("Authorization") == wanted)

        def do_POST(self) -> None:
            form = parse_qs(self.rfile.read(int(self.headers["Content-Length"])).decode())
            self._give(form["scope"][0], form["refresh_token"] == [PASSWORD])

        def _give(self, scope: str, allowed: bool) -> None:
            kind, repository, actions = scope.split(":")
            # As registries do: whoever is not known may look.
            access = [{"type": kind, "name": repository, "actions": actions.split(",") if allowed else ["pull"]}]
            moment = int(time.time())
            told = {
                "iss": "tokens",
                "aud": "test",
                "sub": "",
                "exp": moment + 300,
                "nbf": moment - 60,
                "access": access,
            }
            head = {"typ": "JWT", "alg": "RS256", "x5c": [chain]}
            signed = ".".join(_plain(json.dumps(part).encode()) for part in (head, told))
            signature = key.sign(signed.encode(), padding.PKCS1v15(), hashes.SHA256())
            body = json.dumps({"access_token": f"{signed}.{_plain(signature)}"}).encode()
            self.send_response(200)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    Thread(target=server.serve_forever, daemon=True).start()
    try:
        realm = f"http://127.0.0.1:{server.server_address[1]}/token"
        pem = str(folder / "tokens.pem")
        yield {"token": {"realm": realm, "service": "test", "issuer": "tokens", "rootcertbundle": pem}}
    finally:
        server.shutdown()
        server.server_close()


def log_in(folder: Path, host: str, password: str = PASSWORD, *, refresh: bool = False) -> None:
    """Write the file that ``docker login`` writes, into ``DOCKER_CONFIG``."""
    entry = {"auth": base64.b64encode(f"{USER}:{password}".encode()).decode()}
    entry = {"identitytoken": password} if refresh else entry
    (folder / "config.json").write_text(json.dumps({"auths": {host: entry}}))


def _plain(content: bytes) -> str:
    return base64.urlsafe_b64encode(content).decode().rstrip("=")
