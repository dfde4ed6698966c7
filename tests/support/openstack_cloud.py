"""An OpenStack cloud on loopback, as openstacksdk speaks to it: Keystone, Nova, Glance, Neutron, and their faults.

It answers over real HTTP what the APIs' documents say (Identity v3, Compute v2.1, Image v2, Networking v2.0), so far as
a group of machines asks for it. What a test may break stands in its attributes.
"""

from __future__ import annotations

import json
import re
import socket
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import count
from pathlib import Path
from typing import Any, ClassVar

import yaml

PASSWORD = "not-for-any-log"
Document = dict[str, Any]


@dataclass
class Nova:
    """The project's servers, and what the cloud has."""

    servers: dict[str, Document] = field(default_factory=dict)
    created: list[Document] = field(default_factory=list)
    """Bodies of all that was asked for and made."""
    flavors: dict[str, Document] = field(
        default_factory=lambda: {"f-1": {"id": "f-1", "name": "m1.large", "vcpus": 4, "ram": 8192, "disk": 40}}
    )
    images: dict[str, Document] = field(
        default_factory=lambda: {
            "1a2b3c4d-0000-4000-8000-000000000001": {"name": "debian-12", "architecture": "x86_64", "status": "active"}
        }
    )
    networks: dict[str, Document] = field(
        default_factory=lambda: {"1a2b3c4d-0000-4000-8000-000000000002": {"name": "robots", "status": "ACTIVE"}}
    )
    quota: int = 10
    """Servers that the project may have."""
    builds: bool = False
    """New servers stay in BUILD."""
    no_host: bool = False
    """New servers end in ERROR."""
    lingers: bool = False
    """Servers that are deleted are listed on, as being deleted."""
    password: str = PASSWORD
    fail: dict[str, int] = field(default_factory=dict)
    """By method and path of the service (``POST /servers``), the status of an answer instead of what is asked."""
    lose: set[str] = field(default_factory=set)
    """Of those the answer is lost, after what was asked is done."""
    calls: list[str] = field(default_factory=list)
    on_created: Callable[[str, Document], None] = lambda id_, asked: None
    """Called with id and body of each server that was made."""
    ids: count[int] = field(default_factory=lambda: count(1))


class OpenstackCloud:
    """Use it as a context manager."""

    def __init__(self) -> None:
        self.nova = Nova()

        class Handler(_Handler):
            nova = self.nova

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        self.url = f"http://127.0.0.1:{self._server.server_address[1]}"
        self._thread = threading.Thread(target=self._server.serve_forever, kwargs={"poll_interval": 0.01})

    def __enter__(self) -> OpenstackCloud:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def clouds_yaml(self, folder: Path, **auth: str) -> Path:
        path = folder / "clouds.yaml"
        given = {
            "auth_url": f"{self.url}/identity/v3",
            "username": "skytether",
            "password": PASSWORD,
            "project_name": "robots",
            "user_domain_name": "Default",
            "project_domain_name": "Default",
        } | auth
        path.write_text(yaml.safe_dump({"clouds": {"lab": {"auth": given, "region_name": "RegionOne"}}}))
        path.chmod(0o600)
        return path


class _Handler(BaseHTTPRequestHandler):
    nova: ClassVar[Nova]
    protocol_version = "HTTP/1.1"
    wbufsize = -1  # head and body in one packet
    disable_nagle_algorithm = True

    def log_message(self, *_: object) -> None:
        """Nothing."""

    def do_GET(self) -> None:
        self._answer()

    def do_POST(self) -> None:
        self._answer()

    def do_DELETE(self) -> None:
        self._answer()

    def _answer(self) -> None:
        body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        asked = json.loads(body) if body else {}
        _, service, path = (self.path.split("?")[0] + "//").split("/", 2)
        path = re.sub(r"^/?(v3|v2\.1|v2\.0|v2)(?=/)", "", f"/{path}".replace("//", "/")).rstrip("/") or "/"
        call = f"{self.command} {path}"
        self.nova.calls.append(f"{service} {call}")
        generic = next((one for one in (call, f"{self.command} /servers/*") if one in self.nova.fail), None)
        if generic in self.nova.fail and (generic == call or path.startswith("/servers/")):
            status = self.nova.fail[generic]
            self._send(status, {"error": {"message": "the cloud is not well", "code": status}})
            return
        status, document, headers = getattr(self, f"_{service}")(path, asked)
        if call in self.nova.lose:
            self.connection.shutdown(socket.SHUT_RDWR)
            self.close_connection = True
            return
        self._send(status, document, headers)

    def _send(self, status: int, document: Document | None, headers: dict[str, str] | None = None) -> None:
        body = b"" if document is None else json.dumps(document).encode()
        self.send_response(status)
        for name, value in {**(headers or {}), "Content-Length": str(len(body))}.items():
            self.send_header(name, value)
        self.send_header("Content-Type", "application/json")
        self.end_headers()
        self.wfile.write(body)

    @property
    def _base(self) -> str:
        host, port = self.server.server_address[0], self.server.server_address[1]
        return f"http://{host!s}:{port}"

    def _identity(self, path: str, asked: Document) -> tuple[int, Document, dict[str, str]]:
        if path != "/auth/tokens":
            version = {
                "id": "v3.14",
                "status": "stable",
                "links": [{"rel": "self", "href": f"{self._base}/identity/v3/"}],
            }
            return 200, {"version": version}, {}
        user = asked["auth"]["identity"]["password"]["user"]
        if user["password"] != self.nova.password:
            message = "The request you have made requires authentication."
            return 401, {"error": {"message": message, "code": 401, "title": "Unauthorized"}}, {}
        services = {"compute": "compute/v2.1", "image": "image", "network": "network"}
        catalog = [
            {
                "type": kind,
                "name": kind,
                "id": kind,
                "endpoints": [
                    {
                        "interface": "public",
                        "region": "RegionOne",
                        "region_id": "RegionOne",
                        "id": f"{kind}-public",
                        "url": f"{self._base}/{where}",
                    }
                ],
            }
            for kind, where in services.items()
        ]
        token = {
            "methods": ["password"],
            "expires_at": "2100-01-01T00:00:00.000000Z",
            "issued_at": "2026-01-01T00:00:00.000000Z",
            "user": {"id": "u1", "name": "skytether", "domain": {"id": "default", "name": "Default"}},
            "project": {"id": "p1", "name": "robots", "domain": {"id": "default", "name": "Default"}},
            "roles": [{"id": "r1", "name": "member"}],
            "catalog": catalog,
        }
        return 201, {"token": token}, {"X-Subject-Token": "token-1"}

    def _image(self, path: str, asked: Document) -> tuple[int, Document, dict[str, str]]:
        if path == "/":
            links = [{"rel": "self", "href": f"{self._base}/image/v2/"}]
            return 200, {"versions": [{"id": "v2.9", "status": "CURRENT", "links": links}]}, {}
        return self._named(path, "images", self.nova.images, wrapped=False)

    def _network(self, path: str, asked: Document) -> tuple[int, Document, dict[str, str]]:
        if path == "/":
            links = [{"rel": "self", "href": f"{self._base}/network/v2.0/"}]
            return 200, {"versions": [{"id": "v2.0", "status": "CURRENT", "links": links}]}, {}
        return self._named(path, "networks", self.nova.networks)

    def _named(
        self, path: str, kind: str, there: dict[str, Document], *, wrapped: bool = True
    ) -> tuple[int, Document, dict[str, str]]:
        parts = path.strip("/").split("/")
        if len(parts) > 1 and parts[1] != "detail":
            if parts[1] not in there:
                return 404, {"itemNotFound": {"message": f"{kind} {parts[1]} could not be found.", "code": 404}}, {}
            one = {"id": parts[1], **there[parts[1]]}
            return 200, {kind.removesuffix("s"): one} if wrapped else one, {}
        wanted = re.search(r"[?&]name=([^&]*)", self.path)
        found = [{"id": id_, **one} for id_, one in there.items() if not wanted or one["name"] == wanted[1]]
        return 200, {kind: found}, {}

    def _compute(self, path: str, asked: Document) -> tuple[int, Document | None, dict[str, str]]:
        nova = self.nova
        if path == "/":
            links = [{"rel": "self", "href": f"{self._base}/compute/v2.1/"}]
            version = {"id": "v2.1", "status": "CURRENT", "version": "2.96", "min_version": "2.1", "links": links}
            return 200, {"version": version}, {}
        if path.startswith("/flavors"):
            return self._named(path, "flavors", nova.flavors)
        if path == "/servers/detail":
            return 200, {"servers": list(nova.servers.values())}, {}
        if path == "/servers":
            return self._create(asked["server"])
        id_ = path.rpartition("/")[2]
        if id_ not in nova.servers:
            return 404, {"itemNotFound": {"message": f"Instance {id_} could not be found.", "code": 404}}, {}
        if self.command == "DELETE":
            if nova.lingers:
                nova.servers[id_]["OS-EXT-STS:task_state"] = "deleting"
            else:
                del nova.servers[id_]
            return 204, None, {}
        return 200, {"server": nova.servers[id_]}, {}

    def _create(self, asked: Document) -> tuple[int, Document, dict[str, str]]:
        nova = self.nova
        if len(nova.servers) >= nova.quota:
            n = len(nova.servers)
            message = f"Quota exceeded for instances: Requested 1, but already used {n} of {nova.quota} instances"
            return 403, {"forbidden": {"message": message, "code": 403}}, {}
        number = next(nova.ids)
        id_ = f"9a2b3c4d-0000-4000-8000-{number:012d}"
        state = "ERROR" if nova.no_host else "BUILD" if nova.builds else "ACTIVE"
        server = {
            "id": id_,
            "name": asked["name"],
            "status": state,
            "metadata": asked.get("metadata", {}),
            "created": f"2026-11-26T00:00:{number:02d}Z",
            "OS-EXT-STS:task_state": None,
        }
        if nova.no_host:
            server["fault"] = {"code": 500, "message": "No valid host was found. There are not enough hosts available."}
        nova.servers[id_] = server
        nova.created.append(asked)
        nova.on_created(id_, asked)
        return 202, {"server": {"id": id_, "links": [], "adminPass": "x"}}, {}
