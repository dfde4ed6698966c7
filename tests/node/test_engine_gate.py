"""A node's engine gets the requests that were judged, and not a byte more, however they are written."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import gzip
import io
import json
import os
import re
import socket
import socketserver
import tarfile
import tempfile
import threading
import time
import tracemalloc
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any
from unittest.mock import AsyncMock, MagicMock, Mock
from urllib.parse import parse_qs, quote, urlsplit

import pytest

from skytether.api.service_report import MOST_BYTES
from skytether.api.splice import closed, splice
from skytether.node import machine
from skytether.node.archives import leads_straight, misleads
from skytether.node.cgroups import Cgroups
from skytether.node.engine_gate import EngineGate
from skytether.node.joins import BusyError, Joins
from skytether.node.kin import Kin
from skytether.node.machine import is_taken, picked
from skytether.node.removals import Removals
from skytether.orchestrator.runtimes.docker.options import DockerOptions
from skytether.orchestrator.runtimes.docker.reports import unpacked

ID, OTHER = "f" * 64, "e" * 64
CREATED = b"""{"Image": "a", "Labels": {"skytether.io/owner": "edge"}, "HostConfig": {"NetworkMode": "%s",
"CapDrop": ["ALL"], "SecurityOpt": ["no-new-privileges"], "ReadonlyRootfs": true, "Init": true, "PidsLimit": 9}}"""
WITH_VOLUME = (CREATED % f"container:{ID}".encode()).replace(
    b'"CapDrop"',
    b'"Mounts": [{"Type": "volume", "Source": "skytether-main_state", "Target": "/d", '
    b'"VolumeOptions": {"NoCopy": true, "Labels": {"skytether.io/owner": "edge"}}}], "CapDrop"',
)

OWN_VOLUME = {"Name": "a" * 64, "Destination": "/run/skytether"}
VOLUME = b'{"Name": "skytether-main_state", "Labels": {"skytether.io/owner": "edge"}}'
X, Y, Z = "a" * 64, "b" * 64, "c" * 64


class Engine:
    """Answers, and keeps what it was asked."""

    def __init__(self, path: Path) -> None:
        self.path = str(path)
        self.asked: list[tuple[str, dict[str, str], bytes]] = []
        self.ended = False
        """It takes connections, and answers nobody."""
        self.container: dict[str, Any] = {"HostConfig": {"ReadonlyRootfs": True}, "Mounts": [OWN_VOLUME]}
        self.links: set[str] = set()
        """In its images."""
        self.large: set[str] = set()
        """In its images."""
        self.pipes: set[str] = set()
        """In its images."""
        self.volumes: list[dict[str, Any]] = []
        self.emptied = False
        """What is made there is removed at once by somebody."""
        self.networks: dict[str, dict[str, str]] = {}
        """Labels by name."""
        self.running: set[str] = set()
        """Containers, by their ids."""
        self.paused: set[str] = set()
        """Of those."""
        self.unwritten = False
        """A full disk: its list does not say that they are paused."""
        self.idle: set[str] = set()
        """Others that it has."""
        self.others: dict[str, dict[str, Any]] = {}
        """What orchestrators have, beside the one container: by ids and names what is said of it."""
        self.unlisted = False
        """It lists no containers."""
        self.refuses: set[str] = set()
        """What it is asked, and answers 409 to."""
        self.slow: dict[str, threading.Event] = {}
        self.unknown: set[str] = set()
        """Containers that are none."""
        """By what it is asked, what it waits for before it answers."""
        self.digests: list[str] = []
        """Of the image that it has by any name but "new"."""
        engine = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def _serve(self) -> None:
                body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
                if engine.ended:
                    self.close_connection = True
                    return
                engine.asked.append((f"{self.command} {self.path}", dict(self.headers), body))
                for asked, waits in list(engine.slow.items()):
                    if f"{self.command} {self.path}".startswith(asked):
                        waits.wait(20)
                if self.command == "DELETE" and self.path.startswith("/v1.41/containers/"):
                    engine.running = {one for one in engine.running if one not in self.path}
                other = next((one for one in engine.others if one in self.path), None)
                labels = {"skytether.io/owner": "edge"} if ID in self.path or other else {}
                runs = any(one in self.path for one in engine.running)
                paused = any(one in self.path for one in engine.paused)
                state = {"Running": runs, "Status": "running" if runs else "created", "Paused": paused}
                said = {"Id": ID, "Config": {"Labels": labels}, "Labels": labels, "Image": "a", **engine.container}
                said["State"] = state
                if other:
                    said |= {"Id": other, **engine.others[other]}
                if "/system/df" in self.path:
                    said = {"Containers": [{"Command": "secret"}], "Volumes": engine.volumes}
                if "/images/" in self.path and self.command == "GET":
                    said = {"RepoDigests": engine.digests}
                text = json.dumps(said).encode()
                if self.path.startswith("/distribution/"):
                    text = json.dumps({"Descriptor": {"digest": f"sha256:{ID}"}}).encode()
                new = re.match("/images/(docker.io/)?new", self.path)
                unknown = any(one in self.path for one in engine.unknown)
                missing = new or unknown or (engine.emptied and self.command in ("HEAD", "DELETE"))
                if self.path.startswith("/networks?"):
                    text = json.dumps([{"Name": name} for name in engine.networks]).encode()
                if self.path.startswith("/containers/json"):
                    there = set() if engine.unlisted else engine.running | engine.idle
                    text = json.dumps(
                        [
                            {
                                **engine.others.get(one, {}),
                                "Id": one,
                                "State": "paused" if one in engine.paused and not engine.unwritten else "running",
                            }
                            for one in there
                        ]
                    ).encode()
                if self.path == "/volumes":
                    text = json.dumps({"Volumes": engine.volumes}).encode()
                if engine.networks and self.command == "GET" and (name := self.path.partition("/networks/")[2]):
                    missing, text = (
                        name not in engine.networks,
                        json.dumps({"Labels": engine.networks.get(name), "Containers": {"of others": {}}}).encode(),
                    )
                refused = f"{self.command} {self.path}" in engine.refuses
                self.send_response(
                    409 if refused else 404 if missing else 201 if "/containers/create" in self.path else 200
                )
                asked = parse_qs(urlsplit(self.path).query).get("path", [""])[0]
                stat = {
                    "mode": 1 << 27 if asked in engine.links else 1 << 25 if asked in engine.pipes else 0o644,
                    "size": 1 << 30 if asked in engine.large else 1000,
                    "name": asked.rpartition("/")[2],
                    "mtime": "2026-11-27T12:00:00Z",
                    "linkTarget": "/secret" if asked in engine.links else "",
                }
                self.send_header("X-Docker-Container-Path-Stat", base64.b64encode(json.dumps(stat).encode()).decode())
                self.send_header("Content-Length", str(len(text)))
                with contextlib.suppress(BrokenPipeError):  # whoever asked may wait no more
                    self.end_headers()
                    self.wfile.write(text if self.command != "HEAD" else b"")

            do_HEAD = do_GET = do_POST = do_PUT = do_DELETE = _serve  # noqa: N815 (the library's names)

            def log_message(self, *_: Any) -> None:
                pass

            def address_string(self) -> str:
                return "node"

        class Server(socketserver.ThreadingUnixStreamServer):
            daemon_threads = True

        self.server = Server(self.path, Handler)
        threading.Thread(target=self.server.serve_forever, args=(0.02,), daemon=True).start()

    @property
    def lines(self) -> list[str]:
        return [line for line, _, _ in self.asked]


class Groups(Cgroups):
    """Of these a container runs that has none, too."""

    def go_on(self, container: str) -> bool:
        return container not in self._folders or super().go_on(container)


@pytest.fixture
def engine(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Engine]:
    monkeypatch.setattr("skytether.node.removals.Cgroups", lambda: Cgroups(tmp_path))  # those of this machine's own
    monkeypatch.setattr("skytether.node.join_watch.Cgroups", lambda: Groups(tmp_path))
    monkeypatch.setattr("skytether.node.joins.shims.stop", lambda *_: True)  # its containers have no processes
    monkeypatch.setattr("skytether.node.removals._QUIET_S", 0.0)  # no program was there before
    with tempfile.TemporaryDirectory(prefix="sky-") as folder:
        made = Engine(Path(folder) / "e.sock")
        yield made
        made.server.shutdown()
        made.server.server_close()


def say(engine: Engine, sent: bytes, registries: tuple[str, ...] = ()) -> bytes:
    """What somebody who sends this, and then no more, gets back."""

    async def run() -> bytes:
        gate, path, over = EngineGate(engine.path, (), registries), engine.path + ".way", asyncio.Event()

        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            there = await asyncio.open_unix_connection(engine.path)
            try:
                await splice((reader, writer), there, there=gate.of_link())
            finally:
                there[1].transport.abort()
                writer.transport.abort()
                await closed()
                over.set()

        async with await asyncio.start_unix_server(serve, path):
            reader, writer = await asyncio.open_unix_connection(path)
            writer.write(sent)
            got = b""
            async with asyncio.timeout(20):
                while b"Connection: close" not in got and got.count(b"HTTP/1.1 ") < sent.count(b" HTTP/1.1\r\n"):
                    piece = await reader.read(65536)
                    if not piece:
                        break
                    got += piece
                if b"Connection: close" in got:
                    got += await reader.read()
            writer.close()
            await over.wait()
            await closed()
            return got

    return asyncio.run(run())


def request(line: str, body: bytes = b"", *headers: str) -> bytes:
    rows = "".join(f"{header}\r\n" for header in (f"Content-Length: {len(body)}", *headers))
    return f"{line} HTTP/1.1\r\nHost: a\r\n{rows}\r\n".encode() + body


def test_what_is_passed_on_is_written_anew_and_asks_for_no_other_protocol(engine: Engine) -> None:
    odd = ("Connection: Upgrade", "Upgrade: tcp", "X-Odd: 1", "Content-Type: application/json")
    body = b' {"Memory": 1, "Memory": 2}'
    sent = request("GET /v1.41/info") + request(f"POST /v1.41/containers/{ID}/update", body, *odd)
    assert say(engine, sent).count(b"HTTP/1.1 200") == 2
    looked = {f"GET /containers/{ID}/json", "GET /v1.41/info"}
    asked = [one for one in engine.asked if "/containers/json?" not in one[0]]  # what runs already
    assert sorted(line for line, *_ in asked[:-1]) == sorted(looked)  # which first, the engine's threads say
    line, headers, got = asked[-1]
    assert line == f"POST /v1.41/containers/{ID}/update"
    assert {name.lower() for name in headers} == {"host", "content-length", "content-type"}
    assert got == b'{"Memory": 2}'


def tar(*entries: tuple[str, bytes, str | bytes], form: int = tarfile.USTAR_FORMAT, **more: Any) -> bytes:
    """Name, type, and what is in it or what it links to."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=form) as made:
        for name, kind, content in entries:
            entry = tarfile.TarInfo(name)
            entry.type, entry.mode, entry.uid, entry.gid = kind, 0o400, 65532, 65532
            for key, value in more.items():
                setattr(entry, key, value)
            if isinstance(content, str):
                entry.linkname = content
            else:
                entry.size = len(content)
            made.addfile(entry, io.BytesIO(content) if isinstance(content, bytes) else None)
    return buffer.getvalue()


FOLDER, FILE, LINK = tarfile.DIRTYPE, tarfile.REGTYPE, tarfile.SYMTYPE
GRANT = (("instance", FOLDER, b""),)


def test_an_archive_with_a_grant_is_passed_on_as_it_is(engine: Engine) -> None:
    archive = tar(*GRANT, ("instance/grant.json", FILE, bytes(range(256)) * 1000))
    assert b"200 OK" in say(engine, request(f"PUT /containers/{ID}/archive?path=%2Frun%2Fskytether", archive))
    line, _, got = engine.asked[-1]
    assert (line, got) == (f"PUT /containers/{ID}/archive?path=%2Frun%2Fskytether", archive)
    data = tar(("i-1", FOLDER, b""))
    assert b"200 OK" in say(engine, request(f"PUT /containers/{ID}/archive?path=%2Fvar%2Flib%2Fskytether", data))


@pytest.mark.parametrize(
    "entry", [("../i-1", FOLDER, b""), ("a/b", FOLDER, b""), (".", FOLDER, b""), ("a", LINK, "/"), ("a", FILE, b"a")]
)
def test_a_folder_for_data_is_all_that_is_put_where_others_write_too(engine: Engine, entry: Any) -> None:
    for archive in (tar(entry), tar(("instance/grant.json", FILE, b"a"))):
        sent = request(f"PUT /containers/{ID}/archive?path=%2Fvar%2Flib%2Fskytether", archive)
        assert b"something else than folders of ours and a grant" in say(engine, sent)
    assert not any(line.startswith("PUT") for line in engine.lines)


@pytest.mark.parametrize(
    "archive",
    [
        tar(("a", LINK, "/"), ("a/dev", LINK, "/etc")),
        tar(("instance", LINK, "/")),
        tar(("instance/grant.json", LINK, "/etc/shadow")),
        tar(("instance/grant.json", FILE, b"a")),  # its image may have a link to another volume there
        tar(("instance/grant.json", FILE, b"a"), *GRANT),
        tar(("instance/grant.json", tarfile.LNKTYPE, "data")),
        tar(("instance/grant.json", tarfile.FIFOTYPE, b"")),
        tar(("instance/grant.json", tarfile.CHRTYPE, b"")),
        tar(("i-1", FOLDER, b"")),
        tar(("instance/..", FOLDER, b"")),
        tar(("/instance", FOLDER, b"")),
        tar(("instance/other", FILE, b"a")),
        tar(("instance/grant.json", FILE, b"a"), form=tarfile.PAX_FORMAT, pax_headers={"path": "a"}),
        tar(("instance/grant.json", FILE, b"a"), uid=-1, form=tarfile.GNU_FORMAT),
        tar(("instance/" + "a" * 200, FILE, b"a"), form=tarfile.GNU_FORMAT),
        tar(*GRANT) + tar(("a", LINK, "/")),  # some look behind the end
        tar(*GRANT)[:1024] + b"a" * 512,
        tar(("instance/grant.json", FILE, b"a" * 2000))[:1500],
        tar(*GRANT * 20),
        gzip.compress(tar(*GRANT), mtime=0),
        b"a" * 60_000,
    ],
)
def test_no_archive_changes_the_root_of_a_container(engine: Engine, archive: bytes) -> None:
    """An engine unpacks from the outside and follows links: with `/dev` one, runc makes files on the machine."""
    sent = request(f"PUT /containers/{ID}/archive?path=%2Frun%2Fskytether", archive)
    assert b"something else than folders of ours and a grant" in say(engine, sent)
    assert not any(line.startswith("PUT") for line in engine.lines)


def test_of_a_network_no_container_is_told(engine: Engine) -> None:
    """In an open one are those of the machine's owner, too."""
    engine.networks = {"lan": {"skytether.io/open": "yes"}}
    for version in ("", "/v1.41"):
        got = say(engine, request(f"GET {version}/networks/lan"))
        assert b"skytether.io/open" in got
        assert b"of others" not in got


@pytest.mark.parametrize(
    ("path", "kind"),
    [
        ("/containers/prune?filters=%7B%22label%22%3A+%5B%22skytether.io%2Fguard%22%5D%7D", "x-www-form-urlencoded"),
        (f"/images/create?fromImage=new&tag=sha256%3A{ID}", "x-www-form-urlencoded"),
    ],
)
def test_no_form_says_what_the_query_does_not(engine: Engine, path: str, kind: str) -> None:
    """An engine believes a form before the query, and one is a document of JSON, too."""
    form = json.dumps("a=b&filters={}&fromImage=&fromSrc=http://example/&repo=debian&z=").encode()
    said = say(engine, request(f"POST {path}", form, f"Content-Type: application/{kind}"))
    assert b"the call has a body" in said
    assert b"200 OK" in say(engine, request(f"POST {path}", b"null", f"Content-Type: application/{kind}"))
    _, headers, got = engine.asked[-1]
    assert [line for line in engine.lines if line.startswith("POST")] == [f"POST {path}"]
    assert not got
    assert "content-type" not in {name.lower() for name in headers}


def test_an_engine_hears_of_an_archive_when_all_of_it_is_there(engine: Engine) -> None:
    """While it waits for the rest of one nobody can end that container, whoever it is."""

    async def run() -> None:
        gate, engine_s = EngineGate(engine.path), AsyncMock(asyncio.StreamWriter, write=Mock())
        reader = asyncio.StreamReader()
        archive = tar(*GRANT, ("instance/grant.json", FILE, b"a" * 60_000))
        sent = request(f"PUT /containers/{ID}/archive?path=%2Frun%2Fskytether", archive)
        reader.feed_data(sent[:-1])
        way = asyncio.create_task(gate.of_link()((reader, engine_s), (reader, engine_s)))
        while reader._buffer:  # type: ignore[attr-defined]  # noqa: SLF001 asyncio's own
            await asyncio.sleep(0)
            if reader._waiter is not None:  # type: ignore[attr-defined]  # noqa: SLF001
                break
        assert not engine.lines
        reader.feed_data(sent[-1:])
        reader.feed_eof()
        await way
        assert engine.asked[-1][2] == archive

    asyncio.run(run())


def test_orchestrators_make_some_networks_and_not_all_that_an_engine_has_room_for(engine: Engine) -> None:
    """Its owner could make none any more, and what this machine knows by these addresses elsewhere is out of reach."""
    options = {"com.docker.network.bridge.name": "skt-0123456789"}
    made = {"Name": "skytether-n", "CheckDuplicate": True, "Driver": "bridge", "Options": options}
    body = json.dumps({**made, "Labels": {"skytether.io/network": "filtered"}}).encode()
    engine.networks = {f"skytether-{number}": {} for number in range(11)}
    assert b"200 OK" in say(engine, request("POST /v1.41/networks/create", body))
    assert json.loads(engine.asked[-1][2])["Name"] == "skytether-n"
    engine.networks["skytether-11"] = {}
    assert b"as many as they may" in say(engine, request("POST /v1.41/networks/create", body))
    assert len([line for line in engine.lines if line.startswith("POST")]) == 1


@pytest.mark.parametrize(
    ("networks", "good", "says"),
    [
        ({"lab": {"skytether.io/open": "yes"}}, True, b""),
        ({"lab": {}}, False, b"lab is not of an orchestrator"),  # it was open as the container was made
        ({"lab": None}, False, b"lab is not of an orchestrator"),
        ({"another": {}}, False, b'{"message": "network lab not found"}'),  # as an engine says it
    ],
)
@pytest.mark.parametrize(
    "container",
    [
        {"HostConfig": {"NetworkMode": "lab", "ReadonlyRootfs": True}, "NetworkSettings": {"Networks": {}}},
        {
            "HostConfig": {"NetworkMode": f"container:{X}", "ReadonlyRootfs": True},
            "NetworkSettings": {"Networks": {"lab": {}}},
        },
    ],
)
def test_a_container_starts_in_networks_that_are_open_to_it_still(
    engine: Engine, networks: dict[str, Any], container: dict[str, Any], good: bool, says: bytes
) -> None:
    """It is connected by their names: who closed a network by making it anew would find it in there."""
    engine.networks, engine.container, engine.running = networks, {**container, "Mounts": []}, {X}
    got = say(engine, request(f"POST /v1.41/containers/{ID}/start"))
    assert (b"200 OK" in got) is good
    assert says in got
    assert any(line.endswith("/start") for line in engine.lines) is good


@pytest.mark.parametrize(
    ("mode", "networks", "good"),
    [
        ("skytether", {"skytether": {"skytether.io/network": "filtered"}}, True),
        ("lab", {"lab": {"skytether.io/open": "yes"}}, False),
        ("lab", {"another": {}}, False),  # it may be made again
        (f"container:{ID}", {"skytether": {"skytether.io/network": "filtered"}}, False),
    ],
)
def test_a_guard_has_its_right_in_networks_of_orchestrators_alone(
    engine: Engine, mode: str, networks: dict[str, dict[str, str]], good: bool
) -> None:
    """By that it takes any address there, and what is sent to it."""
    engine.networks, engine.container = networks, {"HostConfig": {"NetworkMode": mode}}
    guard = CREATED.replace(b'"CapDrop"', b'"CapAdd": ["NET_ADMIN"], "CapDrop"') % f"container:{ID}".encode()
    seccomp = json.dumps(next(one for one in DockerOptions().guard_security if one.startswith("seccomp=")))
    guard = guard.replace(b'privileges"]', f'privileges", {seccomp}]'.encode())
    got = say(engine, request("POST /v1.41/containers/create", guard))
    assert (b"no guard has a right in" not in got) is good
    assert any(line.startswith("POST") for line in engine.lines) is good
    joins = json.dumps({"Container": ID}).encode()
    for name, labels in networks.items():
        got = say(engine, request(f"POST /v1.41/networks/{name}/connect", joins))
        assert (b"200 OK" in got) is ("skytether.io/network" in labels)


def test_a_container_starts_where_nobody_moves_what_is_mounted_in_it(engine: Engine) -> None:
    """The kernel's files are hidden by what is in its /dev, and its volumes are mounted while others may use them."""
    engine.networks = {"skytether": {"skytether.io/network": "filtered"}}
    host = {"NetworkMode": "skytether", "ReadonlyRootfs": True}
    start = request(f"POST /v1.41/containers/{ID}/start")
    for mounts, more, says in (
        ([volume("/d", "skytether-d")], {}, b"200 OK"),
        ([volume("/dev", "skytether-d")], {}, b"/dev is the kernel's"),
        ([volume("/sys/fs")], {}, b"/sys/fs is the kernel's"),
        ([volume("dev")], {}, b"dev is no whole path"),
        ([volume("/d", "skytether-d"), volume("d/x")], {}, b"d/x is no whole path"),
        ([volume(".")], {}, b". is no whole path"),
        ([volume("//dev")], {}, b"//dev is no whole path"),
        ([volume("/d/../dev")], {}, b"/d/../dev is no whole path"),
        ([volume("/d", "skytether-d")], {"Tmpfs": {"/dev//x": ""}}, b"/dev/x is the kernel's"),
        ([volume("/d", "skytether-d")], {"Tmpfs": {"/d/x/": ""}}, b"/d/x is in /d, where things can be moved"),
        ([volume("/d", "skytether-d")], {"Tmpfs": {"/lib/x": ""}}, b"/lib is a link in its image"),
    ):
        engine.container, engine.links = {"HostConfig": {**host, **more}, "Mounts": mounts}, {"/lib"}
        assert says in say(engine, start)


@pytest.mark.parametrize(("test", "good"), [(["CMD"], False), (["CMD", "true"], True), (None, True)])
def test_no_container_starts_whose_image_has_a_health_check_that_ends_the_engine(
    engine: Engine, test: list[str] | None, good: bool
) -> None:
    """Of what it was made of it had none: the engine took its image's."""
    engine.networks = {"skytether": {"skytether.io/network": "filtered"}}
    config = {"Labels": {"skytether.io/owner": "edge"}, "Healthcheck": {"Test": test}}
    engine.container = {"Config": config, "HostConfig": {"NetworkMode": "skytether", "ReadonlyRootfs": True}}
    got = say(engine, request(f"POST /v1.41/containers/{ID}/start"))
    assert (b"200 OK" in got) is good
    assert (b"its health check ['CMD'] has no command" in got) is not good
    assert any(line.endswith("/start") for line in engine.lines) is good


@pytest.mark.parametrize("address", ["", "127.0.0.1", "::1"])
def test_no_container_is_published_at_a_port_that_a_program_of_this_machine_has(engine: Engine, address: str) -> None:
    """Engines lead there what comes for it, until they find that it is taken; connected, it is published, too."""
    engine.networks = {"skytether": {"skytether.io/network": "filtered"}}
    joins = request("POST /v1.41/networks/skytether/connect", json.dumps({"Container": ID}).encode())
    starts = request(f"POST /v1.41/containers/{ID}/start")
    with socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET, socket.SOCK_DGRAM) as program:
        program.bind((address, 0))
        port = program.getsockname()[1]
        bindings = {"7600/udp": [{"HostIp": address, "HostPort": str(port)}]}
        host = {"NetworkMode": "skytether", "ReadonlyRootfs": True, "PortBindings": bindings}
        engine.container = {"HostConfig": host}
        for sent in (joins, starts):
            assert f"UDP port {port} of {address or '0.0.0.0'}: address already in use".encode() in say(engine, sent)
        assert not any(line.startswith("POST") for line in engine.lines)
        engine.container = {"HostConfig": host, "NetworkSettings": {"Ports": bindings}}  # it has it itself
        assert b"200 OK" in say(engine, starts)
    engine.container = {"HostConfig": host}
    for sent in (joins, starts):
        assert b"200 OK" in say(engine, sent)


@pytest.mark.parametrize("address", ["", "127.0.0.1", "::1", "192.0.2.1"])
def test_where_any_port_is_asked_for_the_node_chooses_one_that_is_free(engine: Engine, address: str) -> None:
    """An engine tries one after the other, and leads what comes for programs into the container meanwhile."""
    engine.networks = {"skytether": {"skytether.io/network": "filtered"}}
    body = json.loads(CREATED % b"skytether")
    for bound in ({"HostIp": address}, {"HostIp": address, "HostPort": ""}, {"HostIp": address, "HostPort": "7"}):
        body["HostConfig"]["PortBindings"] = {"7600/udp": [bound]}
        assert b"201 Created" in say(engine, request("POST /v1.41/containers/create", json.dumps(body).encode()))
        (sent,) = [sent for line, _, sent in engine.asked if line.endswith("/create")]
        engine.asked.clear()
        made = json.loads(sent)["HostConfig"]["PortBindings"]["7600/udp"]
        port = int(made[0]["HostPort"])
        assert made == [{"HostIp": address, "HostPort": str(port)}]
        assert port == 7 if bound.get("HostPort") == "7" else port > 1023
    engine.container = {"HostConfig": {"NetworkMode": "skytether", "PortBindings": {"7600/udp": [{"HostPort": ""}]}}}
    assert b"at whatever port" in say(engine, request(f"POST /v1.41/containers/{ID}/start"))


def test_of_ports_that_are_for_root_alone_it_is_seen_too_whether_they_are_taken(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as program:
        program.bind(("127.0.0.1", 0))
        port = program.getsockname()[1]
        refusing = MagicMock()
        refusing.return_value.__exit__.return_value = False
        refusing.return_value.__enter__.return_value.bind.side_effect = PermissionError
        monkeypatch.setattr("skytether.node.machine.socket.socket", refusing)
        assert is_taken("0.0.0.0", port)
    assert not is_taken("0.0.0.0", port)


@pytest.mark.parametrize("path", ["/etc/passwd", "/etc/group"])
def test_no_engine_waits_for_ever_for_what_an_image_says_of_users(engine: Engine, path: str) -> None:
    """It reads that as it starts a container, which nobody ends then: of a pipe it waits, of a device it takes all.

    Of a file it keeps each line that fits, in its own memory.
    """
    engine.networks = {"skytether": {"skytether.io/network": "filtered"}}
    engine.container = {"HostConfig": {"NetworkMode": "skytether", "ReadonlyRootfs": True}}
    start = request(f"POST /v1.41/containers/{ID}/start")
    engine.pipes = {path, "/run/pipe"}
    assert f"{path} is a link in its image, or no file".encode() in say(engine, start)
    engine.pipes, engine.large = set(), {path}
    assert f"{path} is a link in its image, or no file, or a large one".encode() in say(engine, start)
    engine.pipes, engine.large = {"/run"}, {"/lib"}
    assert b"200 OK" in say(engine, start)


@pytest.mark.parametrize("tag", ["1", f"sha256:{ID}"])
@pytest.mark.parametrize("image", ["127.0.0.1:8080/x", "localhost/x", "127.1:1/x"])
def test_no_pull_has_the_engine_ask_this_machine(engine: Engine, image: str, tag: str) -> None:
    """It would tell some of what a program on loopback answers."""
    asked = request(f"POST /images/create?fromImage={quote(image, safe='')}&tag={quote(tag)}")
    assert b"is this machine: name it as it joins" in say(engine, asked)
    assert engine.lines == []


def test_what_is_pulled_by_a_name_gets_that_name_at_no_engine(engine: Engine) -> None:
    """Whoever starts something by that name on this machine, with whatever rights, would start what was pulled."""
    pull = request("POST /v1.41/images/create?fromImage=docker.io%2Fnew&tag=1", b"", "X-Registry-Auth: e30=")
    assert b"200 OK" in say(engine, pull, ("docker.io",))
    assert engine.lines[-2:] == [
        "GET /distribution/docker.io/new:1/json",
        f"POST /v1.41/images/create?fromImage=docker.io%2Fnew&tag=sha256%3A{ID}",
    ]
    assert {
        headers.get("X-Registry-Auth") or headers.get("x-registry-auth") for _, headers, _ in engine.asked[-2:]
    } == {"e30="}
    engine.digests = ["docker.io/own@sha256:aa"]
    own = request("POST /v1.41/images/create?fromImage=docker.io%2Fown&tag=1")
    assert b"docker.io/own:1 is this machine's own" in say(engine, own, ("docker.io",))


MOUNTED = [
    {"Type": "volume", "Name": ID, "Destination": "/run/skytether"},
    {"Type": "volume", "Name": "skytether-data", "Destination": "/var/lib/skytether"},
]


def volume(path: str, name: str = ID) -> dict[str, str]:
    return {"Type": "volume", "Name": name, "Destination": path}


def starts(engine: Engine) -> bytes:
    """A start of the container, in a network of ours: an engine mounts its volumes then."""
    engine.networks = {"skytether": {"skytether.io/network": "filtered"}}
    engine.container["HostConfig"] = {"NetworkMode": "skytether", **(engine.container["HostConfig"] or {})}
    return request(f"POST /containers/{ID}/start")


@pytest.mark.parametrize(
    ("mounts", "changes", "links", "says"),
    [
        (MOUNTED, {}, set(), b""),
        ([*MOUNTED, volume("/data"), volume("/var/lib/a")], {}, {"/lib"}, b""),
        (MOUNTED, {"HostConfig": {"ReadonlyRootfs": False}}, set(), b"it may change its own files"),
        (MOUNTED, {"HostConfig": None}, set(), b"it may change its own files"),
        ([volume("/w"), volume("/w/a/b")], {}, set(), b"/w/a/b is in /w, where things can be moved"),
        # Its own volume, of which it hands an open folder to a container that shares another one.
        ([volume("/w"), volume("/w/a")], {}, set(), b"/w/a is in /w, where things can be moved"),
        ([volume("/w"), volume("/w/a", "skytether-w")], {}, set(), b"/w/a is in /w, where things can be moved"),
        ([volume("/w", "skytether-w"), volume("/w/a")], {}, set(), b"/w/a is in /w, where things can be moved"),
        ([volume("/etc", "skytether-w")], {}, set(), b"/etc/hosts is in /etc, where things can be moved"),
        # What ran may leave a pipe there, of its own volume too: the next start waits for it for ever.
        ([volume("/etc/group")], {}, set(), b"/etc/group is in a volume, where things can be moved"),
        ([volume("/etc/passwd")], {}, set(), b"/etc/passwd is in a volume"),
        ([volume("/etc/passwd.d"), volume("/etcetera")], {}, set(), b""),
        # There another program would be the first process, and no engine would end it.
        ([volume("/usr/sbin")], {}, set(), b"/usr/sbin is where the engine's own first process is"),
        ([volume("/sbin/docker-init")], {}, set(), b"/sbin/docker-init is where the engine's own"),
        ([volume("/bin/docker-init")], {}, set(), b"/bin/docker-init is where the engine's own"),
        (
            MOUNTED,
            {"HostConfig": {"ReadonlyRootfs": True, "Tmpfs": {"/sbin/": "exec"}}},
            set(),
            b"/sbin is where the engine's own first process is",
        ),
        ([volume("/usr/sbin2"), volume("/sbin/docker-init2")], {}, set(), b""),
        (MOUNTED, {}, {"/sbin"}, b"/sbin is a link in its image"),
        (MOUNTED, {}, {"/sbin/docker-init"}, b"/sbin/docker-init is a link in its image"),
        ([volume(f"/v{number}") for number in range(64)], {}, set(), b""),
        ([volume(f"/v{number}") for number in range(65)], {}, set(), b"it has too many mounts"),
        ([volume("/a" * 600)], {}, set(), b"it has too many mounts, or at paths that are too long"),
        (
            MOUNTED,
            {"HostConfig": {"ReadonlyRootfs": True, "Tmpfs": {"/a" * 600: ""}}},
            set(),
            b"it has too many mounts",
        ),
        (MOUNTED, {}, {"/etc"}, b"/etc is a link in its image"),
        (MOUNTED, {}, {"/run/skytether"}, b"/run/skytether is a link in its image"),
        ([*MOUNTED, volume("/var/lib/a")], {}, {"/var/lib"}, b"/var/lib is a link in its image"),
        ([*MOUNTED, volume("/a&path=b/c")], {}, {"/a&path=b"}, b"/a&path=b is a link in its image"),
    ],
)
def test_no_engine_looks_into_files_on_a_way_that_somebody_may_move(
    engine: Engine, mounts: list[Any], changes: dict[str, Any], links: set[str], says: bytes
) -> None:
    engine.container, engine.links = {"HostConfig": {"ReadonlyRootfs": True}, "Mounts": mounts, **changes}, links
    sent = starts(engine)
    got = say(engine, sent + sent)
    if not says:
        assert got.count(b"200 OK") == 2
        made = [line for line in engine.lines if line.startswith("POST /containers/create")]
        assert len(made) == 1
        assert f"DELETE /containers/{ID}?force=1&v=1" in engine.lines
    else:
        assert says in got
        assert sent.split(b" HTTP")[0].decode() not in engine.lines


@pytest.mark.parametrize(("leads", "good"), [("/usr/sbin", True), ("/usr/bin", True), ("/data", False), ("", False)])
def test_where_the_engines_first_process_is_an_image_has_no_link_but_to_where_nothing_is_mounted(
    leads: str, good: bool
) -> None:
    link = {"size": 8, "mode": 1 << 27 | 0o777, "mtime": "", "linkTarget": leads}
    assert misleads("/sbin", link) is not good
    assert misleads("/run", link)


def test_what_is_gone_before_it_was_looked_at_has_not_been_looked_at(engine: Engine) -> None:
    """Where nothing is any more no link is found."""
    engine.emptied = True
    sent = starts(engine)
    assert b"was removed meanwhile" in say(engine, sent)
    engine.emptied = False
    assert b"200 OK" in say(engine, sent)


def test_no_orchestrator_starts_what_the_node_made_to_look_at_an_image(engine: Engine) -> None:
    """That image may say of itself whose it is, and have volumes that make the look a false one."""
    say(engine, starts(engine))
    (made,) = [json.loads(body) for line, _, body in engine.asked if line.startswith("POST /containers/create")]
    engine.container = {"Config": {"Labels": {"skytether.io/owner": "edge", **made["Labels"]}}}
    assert b"is not of an orchestrator" in say(engine, request(f"POST /containers/{ID}/start"))


REPORT = f"GET /containers/{ID}/archive?path=%2Frun%2Fskytether%2Finstance%2Freports.json"


STATS = request(REPORT.replace("GET", "HEAD", 1))


def stat_in(answer: bytes) -> Any:
    """What is told of a file."""
    return json.loads(base64.b64decode(answer.partition(b"Path-Stat: ")[2].split(b"\r\n")[0]))


def refuse(*_: Any) -> None:
    raise PermissionError(13, "Permission denied", "reports.json")


@pytest.fixture
def reports(engine: Engine, tmp_path: Path) -> Path:
    """Where the container's are, in its volume."""
    folder = tmp_path / "volume" / "instance"
    folder.mkdir(parents=True)
    mounted = {**OWN_VOLUME, "Type": "volume", "Driver": "local", "Source": str(folder.parent)}
    engine.container = {**engine.container, "Mounts": [mounted]}
    return folder / "reports.json"


def test_a_report_is_read_by_the_node_itself(engine: Engine, reports: Path) -> None:
    """Docker's process for that is root of the machine, and asks in there by what names their owners are called."""
    reports.write_bytes(b"[1, 2]")
    got = say(engine, request(REPORT))
    assert b"200 OK" in got
    assert b"application/x-tar" in got
    assert unpacked(got.partition(b"\r\n\r\n")[2]) == [1, 2]
    assert not any("/archive" in line or line.startswith("POST") for line in engine.lines)


def make_odd(report: Path, how: str) -> None:
    secret = report.parents[2] / "secret"
    secret.write_bytes(b"secret")
    match how:
        case "a link":
            report.symlink_to(secret)
        case "a link on the way":
            (report.parents[2] / "elsewhere").mkdir()
            (report.parents[2] / "elsewhere" / "reports.json").write_bytes(b"secret")
            report.parent.rmdir()
            report.parent.symlink_to("../elsewhere")
        case "a pipe":
            os.mkfifo(report)
        case "a socket":
            with socket.socket(socket.AF_UNIX) as listener:
                listener.bind(str(report))
        case "a folder":
            report.mkdir()
        case "large":
            report.write_bytes(b" " * (MOST_BYTES + 1))


@pytest.mark.parametrize("how", ["a link", "a link on the way", "a pipe", "a socket", "a folder", "large", "nothing"])
def test_of_what_is_no_report_nothing_is_read(engine: Engine, reports: Path, how: str) -> None:
    make_odd(reports, how)
    got = say(engine, request(REPORT))
    assert b"404 Not Found" in got
    assert b"secret" not in got
    if how != "large":
        assert b"404 Not Found" in say(engine, STATS)


def test_of_a_report_size_and_time_are_told_by_the_node_itself(engine: Engine, reports: Path) -> None:
    reports.write_bytes(b"[1, 2]")
    reports.chmod(0o640)
    os.utime(reports, ns=(0, 1_764_000_000_012_345_678))
    got = say(engine, STATS)
    assert b"200 OK" in got
    assert stat_in(got) == {
        "name": "reports.json",
        "size": 6,
        "mode": 0o640,
        "mtime": "2025-11-24T16:00:00.012345678Z",
        "linkTarget": "",
    }
    assert not any("/archive" in line or line.startswith("POST") for line in engine.lines)


@pytest.mark.parametrize(
    "changes", [{"Type": "bind"}, {"Driver": "nfs"}, {"Destination": "/run"}, {"Source": "/nowhere"}]
)
def test_only_a_volume_of_this_machine_has_reports(engine: Engine, reports: Path, changes: dict[str, str]) -> None:
    reports.write_bytes(b"[1, 2]")
    engine.container["Mounts"][0] |= changes
    assert b"404 Not Found" in say(engine, request(REPORT))


def test_of_a_link_nobody_hears_where_it_leads_by_a_node_that_may_not_read(
    engine: Engine, reports: Path, monkeypatch: Any
) -> None:
    """An engine finds that out on the machine itself, where a link may lead by then."""
    monkeypatch.setattr("skytether.node.files.beneath", refuse)
    got = say(engine, STATS)
    assert b"200 OK" in got
    assert stat_in(got) == {
        "name": "reports.json",
        "size": 1000,
        "mode": 0o644,
        "mtime": "2026-11-27T12:00:00Z",
        "linkTarget": "",
    }
    engine.links = {parse_qs(urlsplit(REPORT).query)["path"][0]}
    got = say(engine, STATS)
    assert b"404 Not Found" in got
    assert b"Path-Stat" not in got


def test_a_node_that_may_not_read_reports_says_so(engine: Engine, reports: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr("skytether.node.files.beneath", refuse)
    assert b"add CapabilityBoundingSet=CAP_DAC_READ_SEARCH to the node's unit" in say(engine, request(REPORT))


def test_of_all_that_an_engine_has_only_what_is_ours_is_told(engine: Engine) -> None:
    ours = {"Name": "skytether-a", "Labels": {"skytether.io/owner": "edge"}, "UsageData": {"Size": 7}}
    engine.volumes = [ours, {"Name": "database", "Options": {"o": "password=secret"}, "Labels": None}]
    got = say(engine, request("GET /v1.41/system/df?type=volume&verbose=1"))
    assert json.loads(got.partition(b"\r\n\r\n")[2]) == {"Volumes": [ours]}


def test_all_is_weighed_however_much_an_engine_has_to_tell(engine: Engine) -> None:
    """With 75 volumes of many labels, of nobody's it was known any more what services wrote."""
    labels = {"skytether.io/owner": "edge", **{str(number): "a" * 4000 for number in range(60)}}
    engine.volumes = [{"Name": f"v{number}", "Labels": labels, "UsageData": {"Size": number}} for number in range(80)]
    got = say(engine, request("GET /v1.41/system/df?type=volume&verbose=1"))
    told = json.loads(got.partition(b"\r\n\r\n")[2])["Volumes"]
    assert told[79] == {"Name": "v79", "Labels": {"skytether.io/owner": "edge"}, "UsageData": {"Size": 79}}
    assert len(told) == 80


def test_who_takes_no_answer_of_how_large_all_is_keeps_nobody_else_from_it(engine: Engine) -> None:
    engine.volumes = [{"Name": "v", "Labels": {"skytether.io/owner": "edge"}, "UsageData": {"Size": 7}}]

    async def ask(passes: Any, drain: Any = None, version: str = "v1.41") -> bytes:
        reader, back = asyncio.StreamReader(), AsyncMock(asyncio.StreamWriter, write=Mock())
        back.drain = drain or back.drain
        reader.feed_data(request(f"GET /{version}/system/df"))
        reader.feed_eof()
        await passes((reader, back), (reader, back))
        return b"".join(call.args[0] for call in back.write.call_args_list)

    async def run() -> None:
        gate, takes = EngineGate(engine.path), asyncio.Event()
        stubborn = gate.of_link()
        ways = [asyncio.create_task(ask(stubborn, takes.wait, "v1.999")) for _ in range(12)]
        for _ in range(3):
            assert b'"Size": 7' in await asyncio.wait_for(ask(gate.of_link()), 5)
        takes.set()
        assert all(b'"Size": 7' in told for told in await asyncio.gather(*ways))

    asyncio.run(run())
    assert {line for line in engine.lines if "df" in line} == {"GET /system/df?type=volume&verbose=1"}


def test_no_container_is_made_of_which_an_engine_has_much_to_tell(engine: Engine) -> None:
    """With 44 of an image with a megabyte of labels no list was read any more, and nothing made for anybody."""
    engine.networks = {"skytether": {"skytether.io/network": "filtered"}}
    created = request("POST /v1.41/containers/create", CREATED % b"skytether")
    assert b"201 Created" in say(engine, created)
    engine.container["Config"] = {"Labels": {"skytether.io/owner": "edge", "much": "a" * (64 << 10)}}
    assert b"its description has more than 64 KiB" in say(engine, created)
    assert f"DELETE /containers/{ID}?force=1" in engine.lines


def test_of_many_labels_few_are_kept_in_memory() -> None:
    """With 32 MB of them, an answer took all the memory that the node's program may have."""
    labels = {"skytether.io/owner": "edge"} | {f"{i:x}": "" for i in range(20_000)}
    text = json.dumps([{"Labels": labels}] * 40).encode()
    tracemalloc.start()
    try:
        told = picked(text, "Labels", "skytether.io/owner")
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert told == [{"Labels": {"skytether.io/owner": "edge"}}] * 40
    assert most < 2 * len(text)


def test_a_container_that_no_engine_lets_go_of_holds_up_nobody_else(
    engine: Engine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its seccomp profile had it hang as it started; then a node that was started anew never made anything again."""
    monkeypatch.setattr("skytether.node.removals.PATIENCE_S", 0.1)
    joins = {"HostConfig": {"ReadonlyRootfs": True, "NetworkMode": f"container:{X}"}, "Mounts": []}
    engine.running, engine.others = {X, Z}, {X: in_volumes("skytether-s"), Y: in_volumes("skytether-t"), Z: joins}
    engine.paused = {X}
    hangs, unpause = f"GET /containers/{Z}/json", f"POST /containers/{X}/unpause"
    engine.slow = {hangs: threading.Event(), unpause: threading.Event()}

    async def run() -> None:
        site = Site(engine)
        await asyncio.wait_for(site.start(Y), 5.0)
        await asyncio.sleep(0.3)
        assert unpause not in engine.lines, "while another one is just joining its network"
        kill = f"POST /v1.41/containers/{X}/kill?signal=KILL"
        assert b"another container is just joining its network" in await site.ask(kill)
        engine.slow[hangs].set()
        await site.soon(unpause)
        engine.slow[unpause].set()
        async with asyncio.timeout(10):
            while b"200 OK" not in await site.ask(kill):
                await asyncio.sleep(0.01)

    asyncio.run(run())


def test_a_program_that_was_just_started_has_nobody_ended_whose_network_another_one_joins(
    engine: Engine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its network was then looked up by the number of a process that had ended: another one could have that by then."""
    monkeypatch.setattr("skytether.node.joins._WAIT_S", 0.2)
    joins = {"HostConfig": {"ReadonlyRootfs": True, "NetworkMode": f"container:{X}"}, "Mounts": []}
    engine.running, engine.paused, engine.others = {X, Z}, {X}, {X: in_volumes("skytether-s"), Z: joins}
    engine.slow = {f"POST /containers/{X}/unpause": threading.Event()}

    async def run() -> None:
        site = Site(engine)
        for line in (
            f"POST /v1.41/containers/{X}/kill?signal=KILL",
            f"DELETE /v1.41/containers/{X}?force=1",
        ):
            assert b"another container is just joining its network" in await site.ask(line)
        engine.slow[f"POST /containers/{X}/unpause"].set()
        async with asyncio.timeout(10):
            while b"200 OK" not in await site.ask(f"POST /v1.41/containers/{X}/kill?signal=KILL"):
                await asyncio.sleep(0.01)

    asyncio.run(run())


@pytest.mark.parametrize("how", ["a full disk", "a late list"])
def test_a_program_that_was_just_started_asks_who_is_paused(
    engine: Engine, how: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The list said that it runs, or came too late: what joined its network was in that of whoever had its number."""
    monkeypatch.setattr("skytether.node.joins._WAIT_S", 0.2)
    monkeypatch.setattr("skytether.node.removals._QUIET_S", 1.0)
    lists = machine.listed
    engine.running, engine.paused, engine.unwritten = {X}, {X}, how == "a full disk"
    engine.idle, engine.others = {Y}, {X: in_volumes(), Y: in_volumes(network=f"container:{X}")}

    def late(*asked: Any, **more: Any) -> Any:
        monkeypatch.setattr("skytether.node.removals.listed", lists)
        raise TimeoutError

    if how == "a late list":
        monkeypatch.setattr("skytether.node.removals.listed", late)

    async def run() -> None:
        site = Site(engine)
        assert b"another container is just joining its network" in await site.ask(
            f"POST /v1.41/containers/{X}/kill?signal=KILL"
        )
        await site.soon(f"POST /containers/{X}/unpause")

    asyncio.run(run())


@pytest.mark.parametrize("by", ["the kernel", "the engine"])
def test_who_joined_the_network_of_one_that_ended_meanwhile_is_ended(engine: Engine, tmp_path: Path, by: str) -> None:
    """The kernel ended it for want of memory, paused as it was: by then its number was another's, of the machine."""
    engine.others = {X: in_volumes(), Y: in_volumes(network=f"container:{X}")}
    group = tmp_path / "pids" / "docker" / X
    group.mkdir(parents=True)
    (tmp_path / "pids" / "cgroup.procs").write_text("")
    (group / "tasks").write_text("7\n")

    async def run() -> None:
        site = Site(engine)
        await site.start(X)
        starts = await site.slowly(f"POST /v1.41/containers/{Y}/start")
        assert b"another container is just joining its network" in await site.ask(
            f"POST /v1.41/containers/{X}/start"
        ), "it would have another number then"
        if by == "the kernel":
            (group / "tasks").write_text("")
        else:
            engine.running.discard(X)
        engine.slow.popitem()[1].set()
        said = await starts
        assert b"409 Conflict" in said
        assert b"whose network it joined ended meanwhile" in said
        assert f"POST /containers/{Y}/kill?signal=KILL" in engine.lines

    asyncio.run(run())


def test_nobody_joins_the_network_of_one_that_had_ended_just_before(engine: Engine) -> None:
    """It was paused, and then the kernel ended it before anybody looked; or the engine says nothing of it just now."""
    engine.others = {X: in_volumes(), Y: in_volumes(network=f"container:{X}")}
    said = say(engine, request(f"POST /v1.41/containers/{Y}/start"))
    assert b"says nothing of the container whose network it joins" in said
    assert f"POST /v1.41/containers/{Y}/start" not in engine.lines


@pytest.mark.parametrize("by", ["number", "group"])
def test_nobody_joins_the_network_of_one_that_has_ended_whatever_the_engine_says(
    engine: Engine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, by: str
) -> None:
    """It says for seconds that it runs, where somebody else has a pipe of its health check: J was in the machine's."""
    engine.others = {X: in_volumes(), Y: in_volumes(network=f"container:{X}")}

    async def run() -> None:
        site = Site(engine)
        await site.start(X)
        if by == "number":
            monkeypatch.setattr("skytether.node.joins.shims.stop", lambda *_: False)
        else:
            (tmp_path / "pids" / "docker" / X).mkdir(parents=True)
            (tmp_path / "pids" / "cgroup.procs").write_text("")
            (tmp_path / "pids" / "docker" / X / "tasks").write_text("")
        said = await site.ask(f"POST /v1.41/containers/{Y}/start")
        assert b"whose network it joins has ended, or cannot be kept" in said

    asyncio.run(run())
    assert f"POST /v1.41/containers/{Y}/start" not in engine.lines
    assert engine.lines[-1] == f"POST /containers/{X}/unpause"


def test_a_program_that_ends_leaves_what_is_joined_to_the_next_one(engine: Engine) -> None:
    """It let it go on, and the engine went on with the start: who joined was in the network of the machine for good."""
    engine.others = {X: in_volumes(), Y: in_volumes(network=f"container:{X}")}

    async def run() -> None:
        site = Site(engine)
        await site.start(X)
        await site.begin(Y)

    asyncio.run(run())
    assert f"POST /containers/{X}/pause" in engine.lines
    assert f"POST /containers/{X}/unpause" not in engine.lines


def test_where_no_number_can_be_held_that_is_told_once(
    engine: Engine, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("skytether.node.joins.shims.stop", lambda *_: None)
    engine.others = {one: in_volumes(network=f"container:{X}") for one in (Y, Z)} | {X: in_volumes()}

    async def run() -> None:
        site = Site(engine)
        for one in (X, Y, Z):
            await site.start(one)

    asyncio.run(run())
    assert caplog.text.count("cannot be stopped") == 1


@pytest.mark.parametrize("ended", ["before", "after"])
def test_who_joins_by_what_an_earlier_program_asked_for_is_ended_where_that_ended_meanwhile(
    engine: Engine, ended: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was in the network of the machine for good: an engine says nothing of one that it just starts."""
    monkeypatch.setattr("skytether.node.removals.PATIENCE_S", 0.2)
    monkeypatch.setattr("skytether.node.removals._QUIET_S", 1.0)
    engine.others = {X: in_volumes(), Y: in_volumes(network=f"container:{X}")}
    engine.idle, engine.slow = {X, Y}, {f"GET /containers/{Y}/json": threading.Event()}
    if ended == "after":
        engine.running, engine.paused = {X}, {X}

    async def run() -> None:
        site = Site(engine)
        await site.gate.look_back()
        await asyncio.sleep(0.3)
        engine.running = {Y}
        engine.slow.popitem()[1].set()
        await site.soon(f"POST /containers/{Y}/kill?signal=KILL")

    asyncio.run(run())


def test_what_an_earlier_program_made_to_look_at_an_image_is_removed(engine: Engine) -> None:
    """Whoever had the node's program ended again and again, had these pile up, and nobody else may remove them."""
    look = {"Names": [f"/skytether-look-{'0' * 8}"], "Labels": {"skytether.io/owner": "-"}}
    engine.idle = {X, Y, Z}
    engine.others = {X: {**look, "Created": 1}, Y: {**look, "Created": 1 << 40}, Z: {**look, "Labels": {}}}
    engine.others[OTHER] = in_volumes("skytether-s")

    async def run() -> None:
        site = Site(engine)
        await site.start(OTHER)
        await site.soon(f"DELETE /containers/{X}?force=1&v=1")
        assert not [line for line in engine.lines if line.startswith("DELETE") and (Y in line or Z in line)]

    asyncio.run(run())


def test_a_refusal_takes_one_line_of_the_log_and_many_take_few(
    engine: Engine, caplog: pytest.LogCaptureFixture
) -> None:
    async def refuse() -> None:
        gate = EngineGate(engine.path)
        for number in range(100):
            reader = asyncio.StreamReader()
            reader.feed_data(request(f"GET /a{number}%0A%1b[31mfalse"))
            nobody = AsyncMock(asyncio.StreamWriter, write=Mock())
            await gate.of_link()((reader, nobody), (reader, nobody))

    asyncio.run(refuse())
    assert 1 < len(caplog.messages) < 50
    assert not any(line != line.strip() or "\n" in line or "\x1b" in line for line in caplog.messages)


def test_large_bodies_that_never_end_take_no_memory_beyond_some(engine: Engine) -> None:
    """Of a few only is a large body read; whoever wants little is served meanwhile, and another orchestrator, too."""

    async def run() -> int:
        gate = EngineGate(engine.path)
        passes = gate.of_link()
        readers = [asyncio.StreamReader() for _ in range(100)]
        nobody = AsyncMock(asyncio.StreamWriter, write=Mock())
        head = b"POST /containers/create HTTP/1.1\r\nContent-Length: 200000\r\n\r\n"
        for reader in readers:
            reader.feed_data(head + b" " * 60_000)
        ways = [asyncio.create_task(passes((reader, nobody), (reader, nobody))) for reader in readers]
        small = asyncio.StreamReader()
        small.feed_data(request("GET /info"))
        small.feed_eof()
        await passes((small, nobody), (small, nobody))
        written = b"".join(call.args[0] for call in nobody.write.call_args_list)
        assert written.startswith(b"GET /info")
        other = asyncio.StreamReader()
        other.feed_data(head + b" " * 199_998 + b"{}")
        other.feed_eof()
        await asyncio.wait_for(gate.of_link()((other, nobody), (other, nobody)), 5)
        taken = sum(reader._waiter is not None for reader in readers)  # type: ignore[attr-defined]  # noqa: SLF001 asyncio's own
        for way in ways:
            way.cancel()
        await asyncio.gather(*ways, return_exceptions=True)
        return taken

    assert asyncio.run(run()) == 2


OWN = "9" * 64
"""The volume that X alone has."""


def in_volumes(*names: str, network: str = "skytether") -> dict[str, Any]:
    """A container that has these."""
    mounts = [volume(f"/v{number}", name) for number, name in enumerate(names)]
    return {"HostConfig": {"NetworkMode": network, "ReadonlyRootfs": True}, "Mounts": mounts}


class Site:
    """An orchestrator's connection after another, at one gate."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        engine.networks = {"skytether": {"skytether.io/network": "filtered"}}
        self.gate = EngineGate(engine.path)

    async def ask(self, line: str) -> bytes:
        """What is answered by the gate, or sent on to the engine."""
        reader, back = asyncio.StreamReader(), AsyncMock(asyncio.StreamWriter, write=Mock())
        reader.feed_data(request(line))
        reader.feed_eof()
        await self.gate.of_link()((reader, back), (reader, back))
        return b"".join(call.args[0] for call in back.write.call_args_list)

    async def start(self, container: str) -> None:
        assert b"200 OK" in await self.ask(f"POST /v1.41/containers/{container}/start")
        self.engine.running.add(container)

    async def soon(self, begins: str) -> None:
        """The engine is asked something."""
        async with asyncio.timeout(10):
            while not any(line.startswith(begins) for line in self.engine.lines):
                await asyncio.sleep(0.01)

    async def begin(self, container: str) -> asyncio.Task[None]:
        """Start one, which the engine does not say before it is let."""
        line = f"POST /v1.41/containers/{container}/start"
        self.engine.slow[line] = threading.Event()
        starts = asyncio.create_task(self.start(container))
        await self.soon(line)
        return starts

    async def slowly(self, line: str, step: str = "") -> asyncio.Task[bytes]:
        """Ask something that the engine does not answer before it is let, or of which it does not do a later step."""
        self.engine.slow[step or line] = threading.Event()
        asks = asyncio.create_task(self.ask(line))
        await self.soon(step or line)
        return asks

    @property
    def removed(self) -> list[str]:
        lines = [line for line in self.engine.lines if line.startswith(("DELETE /v1.41", "DELETE /volumes"))]
        return [line.removeprefix("DELETE /").removeprefix("v1.41/") for line in lines]


@pytest.mark.parametrize("by", ["a volume", "a network", "somebody who has ended"])
def test_files_stay_while_somebody_runs_who_may_have_a_folder_of_them(
    engine: Engine, by: str, caplog: pytest.LogCaptureFixture
) -> None:
    """As the engine removes them he makes a folder a link, and it removes what is there, as root."""
    engine.others = {
        X: in_volumes(OWN, "skytether-s"),
        Y: in_volumes("skytether-s", "skytether-t") if by != "a network" else in_volumes(network=f"container:{X}"),
        Z: in_volumes("skytether-t"),
    }

    async def run() -> None:
        site = Site(engine)
        await site.start(X)
        await site.start(Y)
        if by == "somebody who has ended":
            await site.start(Z)
            engine.running.discard(Y)
        assert b"200 OK" in await site.ask(f"DELETE /v1.41/containers/{X}?v=1&link=0&force=1")
        assert site.removed == [f"containers/{X}?link=0&force=1"]
        engine.running.discard(X)
        for _ in range(3):
            said = await site.ask(f"DELETE /v1.41/volumes/{OWN}")
            assert b"409 Conflict" in said
            assert b"containers run that may have a folder of it open" in said
            assert b"Connection: close" not in said
        assert len(site.removed) == 1
        engine.running.clear()
        assert b"200 OK" in await site.ask(f"DELETE /v1.41/volumes/{OWN}?force=0")
        assert site.removed[1:] == [f"volumes/{OWN}?force=0"]

    engine.others[OWN] = {}  # it is an orchestrator's, too
    asyncio.run(run())
    assert not caplog.messages


def test_volumes_go_after_a_container_that_has_no_kin_and_has_ended(
    engine: Engine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By no engine with it: runc takes one for ended of which only the first thread has."""
    goes_on: set[str] = set()
    monkeypatch.setattr("skytether.node.cgroups.Cgroups.go_on", lambda _, container: container in goes_on)
    engine.others = {
        X: in_volumes(OWN, "skytether-s"),
        Y: in_volumes("skytether-t"),
        Z: in_volumes("skytether-s"),
        OWN: {},
    }

    async def run() -> None:
        site = Site(engine)
        for container in (X, Y):
            await site.start(container)
        goes_on.add(X)
        await site.ask(f"DELETE /v1.41/containers/{X}?v=1&force=1")
        assert site.removed == [f"containers/{X}?force=1"]
        assert b"409 Conflict" in await site.ask(f"DELETE /v1.41/volumes/{OWN}")
        goes_on.clear()
        await site.ask(f"DELETE /v1.41/containers/{X}?v=1&force=1")
        await site.start(Z)  # nothing is left that it could have
        await site.ask(f"DELETE /v1.41/containers/{Y}?force=1&v=True")
        assert site.removed[1:] == [f"containers/{X}?force=1", f"volumes/{OWN}", f"containers/{Y}?force=1"]
        await site.gate._removals._forget_ended()  # noqa: SLF001 as when there is no room
        assert site.gate._removals._kin.all() == {Z, "volume skytether-s"}  # noqa: SLF001 all others are forgotten

    asyncio.run(run())


def test_processes_that_go_on_without_a_container_keep_volumes_and_are_named(
    engine: Engine, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After the node was started anew, too; an engine that says nothing of them says not that it has them."""
    monkeypatch.setattr("skytether.node.removals.PATIENCE_S", 0.1)
    group = tmp_path / "pids" / "docker" / Z
    group.mkdir(parents=True)
    (tmp_path / "pids" / "cgroup.procs").write_text("")
    (group / "tasks").write_text("7\n")
    engine.others, engine.volumes, engine.unknown = {OWN: {}}, [{"Name": OWN}], {Z}

    async def run() -> None:
        for slow in ({}, {f"GET /containers/{Z}/json": threading.Event()}):
            engine.slow = slow
            assert b"409 Conflict" in await Site(engine).ask(f"DELETE /v1.41/volumes/{OWN}")
            for one in slow.values():
                one.set()
        site, engine.slow = Site(engine), {}
        assert b"409 Conflict" in await site.ask(f"DELETE /v1.41/volumes/{OWN}")
        (group / "tasks").write_text("")
        assert b"200 OK" in await site.ask(f"DELETE /v1.41/volumes/{OWN}")

    asyncio.run(run())
    assert f"kill -9 $(cat {group}/cgroup.procs)" in caplog.text


def test_many_containers_that_no_engine_lets_go_of_hold_up_others_as_one_does(engine: Engine) -> None:
    hang = [f"{number:064x}" for number in range(12)]
    engine.slow = {f"GET /containers/{one}/json": threading.Event() for one in hang}

    async def run() -> None:
        starts = Removals(engine.path)
        await starts.look_back()
        running = asyncio.create_task(starts._running(hang))  # noqa: SLF001 what all removals ask
        async with asyncio.timeout(2.5):  # one is given up after 3 s
            while not set(engine.slow) <= set(engine.lines):
                await asyncio.sleep(0.01)
        for one in engine.slow.values():
            one.set()
        assert await running == set()

    asyncio.run(run())


@pytest.mark.parametrize("state", ["runs", "starts", "is idle"])
def test_of_what_was_there_before_nobody_knows_whom_it_met(
    engine: Engine, state: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The node's program was started anew: it has not seen what met until then, and what was just being started."""
    monkeypatch.setattr("skytether.node.removals.PATIENCE_S", 0.2)
    engine.volumes = [{"Name": OWN}, {"Name": "skytether-s"}]
    new = "8" * 64
    engine.others = {X: in_volumes(OWN), Y: in_volumes(new), Z: in_volumes()}
    (engine.running if state == "runs" else engine.idle).add(Z)
    if state == "starts":
        engine.slow = {f"GET /containers/{Z}/json": threading.Event()}

    async def run() -> None:
        site = Site(engine)
        await site.start(X)
        await site.start(Y)
        if state == "starts":
            engine.slow.clear()
            engine.running.add(Z)
        await site.ask(f"DELETE /v1.41/containers/{X}?v=1&force=1")
        await site.ask(f"DELETE /v1.41/containers/{Y}?v=1&force=1")
        assert site.removed == [f"containers/{X}?force=1", f"containers/{Y}?force=1", f"volumes/{new}"]

    asyncio.run(run())


def test_a_start_that_an_earlier_program_asked_for_may_wait_while_its_engine_says_that_nothing_runs(
    engine: Engine,
) -> None:
    """Whoever keeps the engine busy with that container had the files of volumes removed in which it ran soon.

    More than one may wait: that one has failed, or has run, tells nothing of the others.
    """
    engine.volumes = [{"Name": OWN}]
    engine.others = {Z: in_volumes(), OWN: {}}
    engine.idle = {Z}
    removes = f"DELETE /v1.41/volumes/{OWN}?force=0"

    async def run() -> None:
        site = Site(engine)
        assert b"409 Conflict" in await site.ask(removes)
        engine.others[Z] = {**in_volumes(), "State": {"Running": False, "Error": "the port is taken"}}
        assert b"409 Conflict" in await site.ask(removes)
        assert b"409 Conflict" in await site.ask(f"POST /v1.41/containers/{Z}/start"), "nor is it started"
        engine.unknown, engine.idle = {Z}, set()
        assert b"200 OK" in await site.ask(removes)

    asyncio.run(run())


def test_who_joins_what_was_there_before_waits_until_no_call_of_an_earlier_program_can_end_that(
    engine: Engine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It waited at the engine, and who joined was in the network of a process of the machine that had that number."""
    engine.others = {X: in_volumes(), Y: in_volumes()}
    engine.others[Y]["HostConfig"] = {"ReadonlyRootfs": True, "NetworkMode": f"container:{X}"}
    engine.running = {X}
    monkeypatch.setattr("skytether.node.removals._QUIET_S", 1.0)

    async def run() -> None:
        began, site = time.monotonic(), Site(engine)
        await site.start(Y)
        assert time.monotonic() - began >= 1.0
        await site.start(Y)

    asyncio.run(run())


def test_who_has_a_volume_with_a_name_waits_until_no_call_of_an_earlier_program_can_remove_it(
    engine: Engine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was asked for while nobody ran, and waited; it began when one had given a folder of it away, and had ended."""
    engine.others = {X: in_volumes(OWN), Y: in_volumes("skytether-s")}
    monkeypatch.setattr("skytether.node.removals._QUIET_S", 1.0)

    async def run() -> None:
        began, site = time.monotonic(), Site(engine)
        await site.start(X)
        assert time.monotonic() - began < 1.0, "by the name of its volume nobody asks for that"
        await site.start(Y)
        assert time.monotonic() - began >= 1.0

    asyncio.run(run())


def test_what_an_earlier_program_paused_after_the_list_was_told_goes_on(
    engine: Engine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """That waited at the engine, and the container stayed paused until it was removed."""
    engine.others, engine.running = {X: in_volumes()}, {X}
    monkeypatch.setattr("skytether.node.removals._QUIET_S", 0.5)
    unpause = f"POST /containers/{X}/unpause"

    async def run() -> None:
        site = Site(engine)
        await site.gate.look_back()
        engine.paused = {X}
        await asyncio.sleep(0.2)
        assert unpause not in engine.lines
        await site.soon(unpause)

    asyncio.run(run())


def test_little_is_put_into_one_container_at_a_time(engine: Engine) -> None:
    """Eighty archives held up its start for 6 s, and others at the engine."""
    engine.others = {X: {"State": {"Status": "created"}, "Mounts": []}}
    line = f"PUT /containers/{X}/archive?path=/run"
    engine.slow = {line: threading.Event()}

    async def run() -> None:
        calls = Removals(engine.path)
        puts = [asyncio.create_task(calls.put(X, line.removeprefix("PUT "), b"", "")) for _ in range(8)]
        while calls._puts[X] < 8:  # noqa: SLF001 how many there are
            await asyncio.sleep(0.01)
        with pytest.raises(BusyError, match="too much is being put"):
            await calls.put(X, line.removeprefix("PUT "), b"", "")
        engine.slow[line].set()
        assert all(await asyncio.gather(*puts))

    asyncio.run(run())


def test_where_the_engine_does_not_list_what_is_there_a_start_may_wait_for_each(
    engine: Engine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who kept it from that had all of it forgotten: it was asked later who runs, and nobody did yet."""
    engine.others = {Z: in_volumes(), OWN: {}}
    engine.idle = {Z}
    removes, lists = f"DELETE /v1.41/volumes/{OWN}?force=0", machine.listed

    def says_nothing(*asked: Any, **more: Any) -> Any:
        monkeypatch.setattr("skytether.node.removals.listed", lists)
        raise TimeoutError

    monkeypatch.setattr("skytether.node.removals.listed", says_nothing)

    async def run() -> None:
        site = Site(engine)
        for _ in range(3):
            assert b"409 Conflict" in await site.ask(removes)
        engine.unknown, engine.idle = {Z}, set()
        assert b"200 OK" in await site.ask(removes)

    asyncio.run(run())


def test_into_what_was_there_before_nothing_is_put(engine: Engine) -> None:
    """It may be about to start: an engine writes through a link that is made there meanwhile."""
    engine.others = {Z: {"Mounts": [OWN_VOLUME]}}

    async def run() -> None:
        for there in (set(), {Z}):
            engine.idle = there
            done = await Removals(engine.path).put(Z, f"/containers/{Z}/archive?path=/run", b"", "")
            assert (done is None) == bool(there)

    asyncio.run(run())


def test_calls_by_which_one_container_may_end_are_few_at_a_time(engine: Engine) -> None:
    """Each waits for its lock at the engine, and so does whoever asks whether it runs."""

    async def run() -> None:
        calls, goes_on = Joins(engine.path), asyncio.Event()
        asks = [asyncio.create_task(calls.end(X, goes_on.wait)) for _ in range(16)]
        while calls._ending[X] < 16:  # noqa: SLF001 how many there are
            await asyncio.sleep(0.01)
        with pytest.raises(BusyError, match="too much is asked"):
            await calls.end(X, goes_on.wait)
        goes_on.set()
        assert all(await asyncio.gather(*asks))
        assert await calls.end(X, goes_on.wait)

    asyncio.run(run())


def test_a_volume_with_a_name_stays_while_anybody_runs_whose_start_nobody_saw(engine: Engine) -> None:
    """Another orchestrator at this engine, by another program of a node, could have had it, and given a folder away."""
    engine.others = {X: in_volumes("skytether-s"), Z: in_volumes(), "skytether-s": {}}

    async def run() -> None:
        site = Site(engine)
        await site.start(X)
        engine.running = {Z}
        removes = "DELETE /v1.41/volumes/skytether-s"
        assert b"409 Conflict" in await site.ask(removes)
        engine.running = set()
        await site.start(X)
        assert b"409 Conflict" in await site.ask(removes)
        engine.running = set()
        assert b"200 OK" in await site.ask(removes)
        assert site.removed == ["volumes/skytether-s"]

    asyncio.run(run())


def test_a_start_that_is_under_way_counts_as_one_that_runs(engine: Engine) -> None:
    engine.others = {X: in_volumes(OWN, "skytether-s"), Y: in_volumes("skytether-s")}

    async def run() -> None:
        site = Site(engine)
        await site.start(X)
        starts, engine.slow = f"POST /v1.41/containers/{Y}/start", {}
        engine.slow[starts] = threading.Event()
        asks = asyncio.create_task(site.ask(starts))
        await site.soon(starts)
        asks.cancel()  # the engine goes on, though nobody waits for it
        await site.ask(f"DELETE /v1.41/containers/{X}?v=1&force=1")
        assert site.removed == [f"containers/{X}?force=1"]
        engine.slow[starts].set()

    asyncio.run(run())


def test_no_kin_starts_while_files_are_removed_and_all_others_do(engine: Engine) -> None:
    engine.others = {X: in_volumes(OWN, "skytether-s"), Y: in_volumes("skytether-s"), Z: in_volumes("skytether-t")}

    async def run() -> None:
        site = Site(engine)
        await site.start(X)
        removes = f"DELETE /volumes/{OWN}"
        asks = await site.slowly(f"DELETE /v1.41/containers/{X}?v=1", removes)
        asks.cancel()
        waits = asyncio.create_task(site.start(Y))
        await site.start(Z)
        await asyncio.sleep(0.1)
        assert not waits.done()
        assert f"POST /v1.41/containers/{Y}/start" not in engine.lines
        engine.slow[removes].set()
        await waits

    asyncio.run(run())


def test_a_start_waits_some_time_for_a_removal_and_is_told(engine: Engine, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("skytether.node.removals._WAIT_S", 0.1)
    engine.others = {X: in_volumes(OWN, "skytether-s"), Y: in_volumes("skytether-s")}

    async def run() -> None:
        site = Site(engine)
        await site.start(X)
        removes = f"DELETE /volumes/{OWN}"
        asks = await site.slowly(f"DELETE /v1.41/containers/{X}?v=1", removes)
        said = await site.ask(f"POST /v1.41/containers/{Y}/start")
        assert b"503 Service Unavailable" in said
        assert b"a volume is being removed that it may get a folder of" in said
        engine.slow[removes].set()
        await asks
        await site.start(Y)

    asyncio.run(run())


def test_an_engine_s_list_is_not_believed_of_who_runs(engine: Engine) -> None:
    """With a full disk one (20.10) starts a container that its list never says to run."""
    engine.others = {X: in_volumes(OWN, "skytether-s"), Y: in_volumes("skytether-s"), OWN: {}}

    async def run() -> None:
        site = Site(engine)
        await site.start(X)
        await site.start(Y)
        engine.unlisted = True
        await site.ask(f"DELETE /v1.41/containers/{X}?v=1&force=1")
        engine.running.discard(X)
        assert b"409 Conflict" in await site.ask(f"DELETE /v1.41/volumes/{OWN}")
        assert site.removed == [f"containers/{X}?force=1"]

    asyncio.run(run())


def test_whose_network_is_joined_is_paused_meanwhile_and_not_ended(
    engine: Engine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the number of its process an engine names the network: once that has ended, one of the machine may have it."""
    monkeypatch.setattr("skytether.node.joins._WAIT_S", 0.2)
    engine.others = {X: in_volumes(), Y: in_volumes(network=f"container:{X}"), Z: in_volumes(network=f"container:{X}")}

    async def run() -> None:
        site = Site(engine)
        await site.start(X)
        starts, ends = f"POST /v1.41/containers/{Y}/start", f"POST /v1.41/containers/{X}/kill?signal=KILL"
        way = await site.begin(Y)
        for ending in (ends, f"DELETE /v1.41/containers/{X}?force=1", f"DELETE /v1.41/containers/{X}?v=1&force=1"):
            assert b"another container is just joining its network" in await site.ask(ending)
        other = asyncio.create_task(site.start(Z))
        engine.slow[starts].set()
        await asyncio.gather(way, other)
        pause, unpause = f"POST /containers/{X}/pause", f"POST /containers/{X}/unpause"
        done = [line for line in engine.lines if line in (pause, starts, unpause)]
        assert done[:3] == [pause, starts, unpause]
        assert [line for line in engine.lines if line.endswith("pause")] == [pause, unpause] * 2, "one after the other"
        ended = await site.slowly(ends)
        engine.running -= {Y}
        assert b"whose network it joins is being ended" in await site.ask(starts)
        engine.slow[ends].set()
        assert b"200 OK" in await ended

    asyncio.run(run())


def test_a_container_that_somebody_else_paused_stays_paused(engine: Engine) -> None:
    engine.others = {X: in_volumes(), Y: in_volumes(network=f"container:{X}")}
    engine.refuses = {f"POST /containers/{X}/pause"}

    async def run() -> None:
        assert b"409" in await Site(engine).ask(f"POST /v1.41/containers/{Y}/start")

    asyncio.run(run())
    assert f"POST /containers/{X}/unpause" not in engine.lines


def test_who_ends_a_container_goes_before_those_that_wait_to_join_its_network(engine: Engine) -> None:
    """A dozen that joined it again and again, and nobody ended it any more."""
    engine.others = {X: in_volumes(), Y: in_volumes(network=f"container:{X}"), Z: in_volumes(network=f"container:{X}")}

    async def run() -> None:
        site = Site(engine)
        await site.start(X)
        starts, ends = f"POST /v1.41/containers/{Y}/start", f"POST /v1.41/containers/{X}/kill?signal=KILL"
        first = await site.begin(Y)
        waits = asyncio.create_task(site.ask(f"POST /v1.41/containers/{Z}/start"))
        await asyncio.sleep(0.05)
        ending = asyncio.create_task(site.ask(ends))
        await asyncio.sleep(0.05)
        assert ends not in engine.lines, "while another one is joining"
        assert b"whose network it joins is being ended" in await site.ask(f"POST /v1.41/containers/{Z}/start")
        engine.slow[starts].set()
        await first
        assert b"200 OK" in await ending
        assert b"whose network it joins is being ended" in await waits

    asyncio.run(run())


def test_joins_of_one_network_that_wait_for_each_other_are_few(engine: Engine) -> None:
    """Five hundred in line took all places of starts, and nobody started anything any more."""
    many = [f"{number:064x}" for number in range(1, 20)]
    engine.others = {X: in_volumes(), Y: in_volumes()}
    engine.others |= {one: in_volumes(network=f"container:{X}") for one in many}

    async def run() -> None:
        site = Site(engine)
        await site.start(X)
        starts = f"POST /v1.41/containers/{many[0]}/start"
        first = await site.begin(many[0])
        rest = [asyncio.create_task(site.ask(f"POST /v1.41/containers/{one}/start")) for one in many[1:]]
        while sum(one.done() for one in rest) < len(rest) - 3:
            await asyncio.sleep(0.01)
        refused = {one.result()[-120:] for one in rest if one.done()}
        assert len(refused) == 1
        assert b"too many containers join" in refused.pop()
        await asyncio.wait_for(site.start(Y), 5)
        engine.slow[starts].set()
        await first
        await asyncio.gather(*rest)

    asyncio.run(run())


def test_of_a_container_of_which_an_engine_says_nothing_nobody_waits_who_asks_of_another(engine: Engine) -> None:
    """While it starts one it does not answer for it: sixty such questions had all threads, for a minute."""
    hangs = f"GET /containers/{Y}/json"
    engine.others, engine.slow = {X: in_volumes(), Y: in_volumes()}, {hangs: threading.Event()}

    async def run() -> None:
        site = Site(engine)
        waiting = [asyncio.create_task(site.ask(f"GET /v1.41/containers/{Y}/json")) for _ in range(60)]
        await site.soon(hangs)
        await asyncio.wait_for(site.start(X), 20)
        engine.slow[hangs].set()
        await asyncio.gather(*waiting)

    asyncio.run(run())


def test_what_is_put_into_a_container_is_put_there_before_it_was_ever_started(engine: Engine) -> None:
    """As the engine writes it, what runs there makes it a link to a device."""
    archive = tar(*GRANT, ("instance/grant.json", FILE, b"a"))
    puts = request(f"PUT /v1.41/containers/{ID}/archive?path=%2Frun%2Fskytether", archive)
    assert b"200 OK" in say(engine, puts)
    engine.running = {ID}
    assert b"before it was ever started" in say(engine, puts)
    assert len([line for line in engine.lines if line.startswith("PUT")]) == 1


@pytest.mark.parametrize(
    "mounts",
    [
        [],
        [{"Name": "skytether-shared", "Destination": "/run/skytether"}],
        [OWN_VOLUME, {"Name": "skytether-shared", "Destination": "/run/skytether"}],
        [{**OWN_VOLUME, "Destination": "/run"}],
    ],
)
def test_a_grant_is_put_where_no_other_container_has_a_folder_of_it(engine: Engine, mounts: list[Any]) -> None:
    """What had the same volume made it a link to a device of the image: the engine wrote to a disk of the machine."""
    engine.container = {**engine.container, "Mounts": mounts}
    archive = tar(*GRANT, ("instance/grant.json", FILE, b"a"))
    puts = f"PUT /v1.41/containers/{ID}/archive?path="
    assert b"a grant into a volume at /run/skytether that has no name" in say(
        engine, request(f"{puts}%2Frun%2Fskytether", archive)
    )
    assert not any(line.startswith("PUT") for line in engine.lines)
    data = tar(("instance-1", tarfile.DIRTYPE, b""))
    assert b"200 OK" in say(engine, request(f"{puts}%2Fvar%2Flib%2Fskytether", data)), (
        "folders go where others are, too"
    )


def test_what_has_ended_is_forgotten_before_there_is_no_room_for_more(engine: Engine) -> None:
    engine.others = {X: in_volumes("skytether-s"), Y: in_volumes("skytether-t"), Z: in_volumes("skytether-u")}

    async def run() -> None:
        site = Site(engine)
        kin = site.gate._removals._kin = Kin(most=4)  # noqa: SLF001 as many as few containers have
        await site.start(X)
        await site.start(Y)
        engine.running.discard(X)
        await site.start(Z)
        assert not kin.lost

    asyncio.run(run())


@pytest.mark.parametrize("slow", [False, True])
def test_where_there_is_no_room_who_starts_is_not_refused_and_anybody_may_be_kin_of_anything(
    engine: Engine, slow: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By 520 starts with 64 volumes each, one orchestrator kept all others from ever starting anything."""
    engine.others = {X: in_volumes("skytether-s"), Y: in_volumes("skytether-t"), Z: in_volumes("skytether-u"), OWN: {}}
    if slow:
        monkeypatch.setattr("skytether.node.removals._LOOK_BACK_S", 0.0)

    async def run() -> None:
        site = Site(engine)
        site.gate._removals._kin = Kin(most=4)  # noqa: SLF001 as many as few containers have
        for container in (X, Y, Z):
            await site.start(container)
        for running in ({X}, {Y}, {Z}):
            engine.running = running
            assert b"409 Conflict" in await site.ask(f"DELETE /v1.41/volumes/{OWN}"), "nobody knows who met whom"
        assert b"200 OK" in await site.ask(f"DELETE /v1.41/containers/{Z}?v=1&link=0&force=1")
        assert site.removed == [f"containers/{Z}?link=0&force=1"], "its volumes stay, as long as it runs"
        engine.running, engine.idle = set(), {X, Y}
        assert b"200 OK" in await site.ask(f"DELETE /v1.41/volumes/{OWN}?force=0")
        await site.start(X)
        assert b"200 OK" in await site.ask("DELETE /v1.41/volumes/skytether-t?force=0"), "now it is known again"
        assert b"409 Conflict" in await site.ask("DELETE /v1.41/volumes/skytether-s?force=0")

    engine.others |= {"skytether-t": {}, "skytether-s": {}}
    asyncio.run(run())


@pytest.mark.parametrize("most", [1 << 17, 10])
def test_however_much_an_engine_has_to_tell_what_is_asked_for_is_passed_on(
    engine: Engine, most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With lists of more than 16 MiB, a node that was started anew never made anything for anybody again."""
    monkeypatch.setattr("skytether.node.machine._MOST_LISTED", most)
    labels = {"skytether.io/owner": "edge", **{str(number): "a" * 4000 for number in range(60)}}
    engine.volumes = [{"Labels": labels, "Name": f"skytether-{number}"} for number in range(80)]
    engine.others, engine.running = {X: in_volumes("skytether-s"), Y: in_volumes("skytether-79"), OWN: {}}, {Y}

    async def run() -> None:
        site = Site(engine)
        await site.start(X)
        for volume in (OWN, "skytether-79"):
            said = await site.ask(f"DELETE /v1.41/volumes/{volume}")
            assert (b"409 Conflict" in said) == (most == 10 or volume == "skytether-79")

    engine.others |= {"skytether-79": {}}
    asyncio.run(run())


@pytest.mark.parametrize(
    ("sent", "says"),
    [
        (request(f"DELETE /containers/{OTHER}"), b"is not of an orchestrator"),
        (request(f"POST /containers/{OTHER}/kill"), b"is not of an orchestrator"),
        (request(f"POST /containers/{ID[:12]}/kill"), b"nothing that a site needs"),
        (request("GET /containers/database/json"), b"nothing that a site needs"),
        (request("DELETE /networks/bridge"), b"nothing that a site needs"),
        (request("DELETE /networks/skytether-b"), b"skytether-b is not of an orchestrator"),
        (request("DELETE /volumes/skytether-b"), b"skytether-b is not of an orchestrator"),
        (request(f"PUT /containers/%65{OTHER[1:]}/archive?path=/run/skytether", b"tar"), b"is not of an orchestrator"),
        (request("POST /containers/create", CREATED % b"bridge"), b"bridge is not of an orchestrator"),
        (request("POST /containers/create", CREATED % b"0123456789ab"), b"its network is"),
        (request("POST /containers/create", CREATED % f"container:{OTHER}".encode()), b"is not of an orchestrator"),
        (request("POST /networks/bridge/connect", b'{"Container": "%s"}' % ID.encode()), b"bridge is not of"),
        (request("POST /containers/create", WITH_VOLUME), b"skytether-main_state is not of an orchestrator"),
        (request("POST /volumes/create", VOLUME), b"skytether-main_state is not of an orchestrator"),
        (request("POST /containers/database%2Fexec", b"{}"), b"nothing that a site needs"),
        (request("POST /containers/create", b'{"HostConfig": {"Binds": ["/:/host"]}}'), b"'Binds'"),
        (request("GET /info", b"POST /build HTTP/1.1\r\n\r\n"), b"its body is no JSON"),
        (request("GET /networks/bridge"), b"bridge is not of an orchestrator"),
        (request(f"POST /v1.23/containers/{ID}/start", b'{"Binds": ["/:/host"]}'), b"nothing that a site needs"),
        (request("GET /info", b"", "Content-Length: 5"), b"no plain request"),
        (request("GET /info", b"", "Transfer-Encoding: chunked"), b"no plain request"),
        (request("GET /info", b"", " folded: 1"), b"no plain request"),
        (request("GET /info", b"", "Content-Length : 5"), b"no plain request"),
        (request("GET http://a/info"), b"no plain request"),
        (b"GET /info\r\n\r\n", b"no plain request"),
        (b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n", b"no plain request"),
        (request("POST /images/create?fromImage=a&fromImage=b"), b"its query or its length is odd"),
        (b"POST /images/create HTTP/1.1\r\nContent-Length: 99999999999\r\n\r\n", b"its query or its length is odd"),
        (b"POST /images/create HTTP/1.1\r\nContent-Length: " + b"9" * 5000 + b"\r\n\r\n", b"its length is odd"),
        (request("POST /containers/create", b"[" * 100_000), b"its body is no JSON"),
        (b"GET /" + b"a" * 200_000, b"refuses it"),
    ],
)
def test_what_is_refused_is_told_and_the_engine_hears_nothing_of_it(engine: Engine, sent: bytes, says: bytes) -> None:
    got = say(engine, sent + request("GET /version"))
    assert b"403 Forbidden" in got
    assert says in got
    looks = ("GET /containers/", "GET /networks/", "GET /volumes/")
    assert [line for line in engine.lines if not line.startswith(looks)] == []


def test_an_engine_that_does_not_answer_is_told_apart_from_a_refusal(engine: Engine) -> None:
    engine.ended = True
    assert b"503 Service Unavailable" in say(engine, request(f"POST /containers/{ID}/start"))


@pytest.mark.parametrize(
    ("leads", "straight"),
    [("usr/sbin", True), ("/usr/sbin", True), ("/v/y", False), ("v/../usr/sbin", False), ("//usr/sbin", False)],
)
def test_of_the_link_to_the_engines_first_process_its_own_words_count(leads: str, straight: bool) -> None:
    """An engine tells where it ends: by way of a link in a volume's place, it ends elsewhere when that is mounted."""
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w") as made:
        entry = tarfile.TarInfo("sbin")
        entry.type, entry.linkname = tarfile.SYMTYPE, leads
        made.addfile(entry)
    assert leads_straight(packed.getvalue(), "/usr/sbin") is straight
    assert not leads_straight(b"", "/usr/sbin")
    assert not leads_straight(bytes(1024), "/usr/sbin")
