"""What a machine is, and its engine: looked at, never changed."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import hashlib
import http.client
import json
import os
import platform
import re
import shutil
import socket
import time
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import ijson
import psutil
from typing_extensions import override

from skytether import __version__
from skytether.api.node import Machine

from .calls import address_of

_ARCHITECTURES = {"x86_64": "amd64", "aarch64": "arm64", "armv7l": "arm"}
_ENGINE_S = 10.0
_MOST, _MOST_HEAD, _PIECE = 1 << 20, 1 << 16, 1 << 16
"""Bytes of an engine's answer, of the head before it, and of what is read at a time."""
_CONNECT_AGAIN_S = 0.02
_MOST_TEXT = 1024
"""Characters of what is asked for of a thing in a list; longer ones are left out."""
_HEAVY = {"Args", "Cmd", "Entrypoint", "Env", "ExposedPorts", "OnBuild", "Shell", "Volumes"}
_OURS, _MOST_OF_ONE = "skytether", 4096
ANYWHERE = "0.0.0.0"  # noqa: S104 (nobody listens)
_TRIES = 16
"""For a port that is free for IPv6, too."""
_MOST_LISTED, _LIST_S = 1 << 17, 30.0
"""Things of a list, and how long it may take to be read [s]."""
_PLAIN = {"string", "number", "boolean"}
_STATUS = re.compile(rb"HTTP/1\.[01] ([1-5]\d\d)\b")


class TooMuchError(ValueError):
    """It has more to tell than is listened to."""


@dataclass(frozen=True)
class EngineInfo:
    """What an engine says of itself."""

    version: str
    api_version: str
    architecture: str
    cpu: float
    memory_mb: int
    folder: str
    """Where it keeps what it has."""


@dataclass(frozen=True)
class Answer:
    """What an engine said."""

    status: int
    headers: Mapping[str, str]
    """Names in lower case."""
    content: bytes


class _Connection(http.client.HTTPConnection):
    def __init__(self, path: str, patience: float) -> None:
        super().__init__("engine", timeout=patience)
        self._path = path

    @override
    def connect(self) -> None:
        self.sock = socket.socket(socket.AF_UNIX)
        self.sock.settimeout(self.timeout)
        self.sock.connect(self._path)


def ask_engine(path: str) -> EngineInfo:
    """Ask an engine what it is.

    Raises:
        OSError: It does not answer.
        ValueError: It answers something else.
    """
    version, info = _get(path, "/version"), _get(path, "/info")
    try:
        return EngineInfo(
            version=str(version["Version"])[:100],
            api_version=str(version["ApiVersion"]),
            architecture=_ARCHITECTURES.get(str(info["Architecture"]), str(info["Architecture"])),
            cpu=float(info["NCPU"]),
            memory_mb=int(info["MemTotal"]) >> 20,
            folder=str(info.get("DockerRootDir") or ""),
        )
    except (KeyError, TypeError) as error:
        raise ValueError(f"what listens at {path} is no Docker engine: its answer has no {error}") from None


def _get(path: str, what: str) -> Any:
    status, document = ask_json(path, what)
    if status != http.HTTPStatus.OK:
        raise ValueError(f"what listens at {path} is no Docker engine: it answers {status} to {what}")
    return document


def ask_json(path: str, what: str) -> tuple[int, Any]:
    """Status and document that an engine answers with.

    Raises:
        OSError: It does not answer.
        ValueError: It answers something else.
    """
    answer = ask(path, what)
    return answer.status, json.loads(answer.content)


def ask(
    path: str,
    what: str,
    *,
    method: str = "GET",
    body: Any = None,
    patience: float = _ENGINE_S,
    most: int = _MOST,
) -> Answer:
    """One call.

    Args:
        path: Of the engine's socket.
        what: Path and query.
        method: As HTTP names it.
        body: Sent as JSON, unless it is None.
        patience: Seconds for each step of it.
        most: Bytes of the answer, which is cut off there.

    Raises:
        OSError: It does not answer.
        ValueError: It answers something else.
    """
    with _answered(path, what, method, body, patience) as answer:
        return Answer(answer.status, {k.lower(): v for k, v in answer.getheaders()}, answer.read(most))


@contextlib.contextmanager
def _answered(path: str, what: str, method: str, body: Any, patience: float) -> Iterator[http.client.HTTPResponse]:
    connection = _Connection(path, patience)
    try:
        text = None if body is None else json.dumps(body)
        connection.request(method, what, text, {"Content-Type": "application/json"} if text else {})
        yield connection.getresponse()
    except http.client.HTTPException as error:
        raise ValueError(f"what listens at {path} is no Docker engine: it speaks no HTTP") from error
    finally:
        connection.close()


def listed(
    path: str, what: str, lists: Collection[str], keys: Collection[str], *, patience: float = _ENGINE_S
) -> list[dict[str, Any]]:
    """Of each thing in a list what is asked for: however much there is of all else, it takes no memory.

    Args:
        path: Of the engine's socket.
        what: Path and query.
        lists: Where a thing may be in the document: ``item``, ``Volumes.item``.
        keys: What is asked for of each, which are no objects: ``Id``, ``HostConfig.NetworkMode``.
        patience: Seconds for each step of it.

    Raises:
        OSError: It does not answer.
        TooMuchError: Of more than `_MOST_LISTED`, or for longer than `_LIST_S`.
        ValueError: It answers something else.
    """
    found: list[dict[str, Any]] = []
    start = ""
    with _answered(path, what, "GET", None, patience) as answer:
        until = time.monotonic() + _LIST_S
        if answer.status != http.HTTPStatus.OK:
            raise ValueError(f"it answers {answer.status}")
        try:
            for where, event, value in ijson.parse(answer, use_float=True):
                if event == "start_map" and where in lists:
                    start = f"{where}."
                    found.append({})
                    if len(found) > _MOST_LISTED or time.monotonic() > until:
                        raise TooMuchError("it has too much to tell")
                elif found and event in _PLAIN and where.startswith(start) and (key := where[len(start) :]) in keys:
                    found[-1][key] = value
                    if isinstance(value, str) and len(value) > _MOST_TEXT:
                        del found[-1][key]
        except ijson.JSONError as error:
            raise ValueError(f"its answer is no JSON: {error}") from error
    return found


async def ask_soon(path: str, what: str, *, method: str = "GET", patience: float = _ENGINE_S, **how: Any) -> Answer:
    """The same, by `ask_long`; ``patience``: for all of it [s].

    While an engine starts a container it says nothing of it: of threads that wait for that there would soon be none.
    """
    try:
        async with asyncio.timeout(patience):
            return await ask_long(path, what, method=method, **how)
    except TimeoutError:
        raise TimeoutError(f"it says nothing for {patience:g} s") from None


async def ask_long(
    path: str,
    what: str,
    *,
    method: str,
    body: Any = None,
    headers: Mapping[str, str] | None = None,
    most: int = _MOST,
) -> Answer:
    """One call that an engine may take any time for. It takes no thread meanwhile.

    Args:
        path: Of the engine's socket.
        what: Path and query.
        method: As HTTP names it.
        body: Sent as JSON, unless it is None; bytes as they are.
        headers: More of them.
        most: Bytes of the answer, which is cut off there.

    Raises:
        OSError: It does not answer.
        ValueError: It answers something else.
    """
    reader, writer = await asyncio.open_unix_connection(sock=await _connect(path))
    try:
        # By this version an engine says no more than one answer, in one piece.
        content = body if isinstance(body, bytes) else b"" if body is None else json.dumps(body).encode()
        kind = "application/x-tar" if method == "PUT" else "application/json"
        given = {"Host": "engine", **({"Content-Type": kind} if content else {}), **(headers or {})}
        rows = "".join(f"{key}: {value}\r\n" for key, value in given.items())
        asked = f"{method} {what} HTTP/1.0\r\n{rows}Content-Length: {len(content)}\r\n\r\n"
        writer.write(asked.encode() + content)
        said, start = bytearray(), 0
        while len(said) < (start + most if start else _MOST_HEAD) and (piece := await reader.read(_PIECE)):
            said += piece
            start = start or said.find(b"\r\n\r\n") + 4 * (b"\r\n\r\n" in said)
    finally:
        writer.transport.abort()
        with contextlib.suppress(OSError):
            await writer.wait_closed()
    if not (found := _STATUS.match(said)) or start < len(b"\r\n\r\n"):
        raise ValueError("it ended before it said whether it did it")
    lines = (line.partition(":") for line in said[:start].decode("latin-1").split("\r\n")[1:])
    heads = {name.lower(): value.strip() for name, _, value in lines if name}
    return Answer(int(found[1]), heads, bytes(said[start : start + most]))


async def _connect(path: str) -> socket.socket:
    """Connect: asyncio takes a socket for connected where the kernel says that too many wait to be."""
    made = socket.socket(socket.AF_UNIX)
    made.setblocking(False)
    try:
        while True:
            try:
                made.connect(path)
            except BlockingIOError:
                await asyncio.sleep(_CONNECT_AGAIN_S)
            else:
                return made
    except BaseException:
        made.close()
        raise


def lean(content: bytes) -> Any:
    """JSON of what an engine has, without what takes much memory and says nothing that matters here.

    Of labels ours are kept, and of what runs in a container nothing.

    Raises:
        ValueError: It is none, or there is much of something else.
    """

    def thin(found: dict[str, Any]) -> dict[str, Any]:
        for key in _HEAVY & found.keys():
            del found[key]
        if isinstance(labels := found.get("Labels"), dict):
            found["Labels"] = {key: value for key, value in labels.items() if key.startswith(_OURS)}
        return found

    found = json.loads(content, object_hook=thin)
    if _is_long(found):
        raise ValueError("it has too much of something")
    return found


def _is_long(found: Any) -> bool:
    if not isinstance(found, dict | list):
        return False
    return len(found) > _MOST_OF_ONE or any(map(_is_long, found.values() if isinstance(found, dict) else found))


def picked(content: bytes, *keys: str) -> Any:
    """JSON of which objects have no other keys than these; of many labels, say, Python makes twenty times as much.

    Raises:
        ValueError: It is none.
    """
    return json.loads(content, object_hook=lambda found: {key: found[key] for key in keys if key in found})


def free_mb(folder: str) -> int | None:
    """Room on the disk of a folder, or of the nearest one above it that is there; None: it cannot be seen from here."""
    place = Path(folder or "/")
    while not place.exists() and place != place.parent:
        place = place.parent
    try:
        return shutil.disk_usage(place).free >> 20
    except OSError:
        return None


def describe(engine: EngineInfo | None, echo: int | None) -> Machine:
    """This machine, as its orchestrators are told."""
    return Machine(
        id=machine_id(),
        hostname=socket.gethostname()[:253],
        system=_system()[:120],
        architecture=engine.architecture if engine else _ARCHITECTURES.get(platform.machine(), platform.machine())[:32],
        cpu=engine.cpu if engine else float(os.cpu_count() or 1),
        memory_mb=engine.memory_mb if engine else psutil.virtual_memory().total >> 20,
        disk_mb=free_mb(engine.folder if engine else "/") or 0,
        engine=engine.version if engine else "",
        version=__version__,
        echo=echo,
    )


def architecture() -> str:
    """Of this machine, as container images name it."""
    return _ARCHITECTURES.get(platform.machine(), platform.machine())


def machine_id() -> str:
    """The same as long as this is the same machine; tells nothing of it."""
    for path in ("/etc/machine-id", "/var/lib/dbus/machine-id"):
        try:
            text = Path(path).read_text().strip()
        except OSError:
            continue
        if text:
            return hashlib.sha256(f"skytether node {text}".encode()).hexdigest()[:32]
    return ""


def address_towards(url: str) -> str | None:
    """This machine's address by which it reaches an orchestrator; None: there is no way there. Nothing is sent."""
    return own_address(*address_of(url))


def own_address(host: str, port: int) -> str | None:
    """The same, by which it reaches a host."""
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.connect(address)
            return str(probe.getsockname()[0]).partition("%")[0]
    except OSError:
        return None


def is_taken(address: str, port: int) -> bool:
    """Whether a program of this machine has that UDP port, at that address or at all; empty: at any address."""
    if not address:
        return is_taken(ANYWHERE, port) or (socket.has_ipv6 and is_taken("::", port))
    with socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            if ":" in address:
                probe.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
            probe.bind((address, port))
        except PermissionError:  # a port of root's, and the node's program has no right
            return any(_has_port(Path(f"/proc/net/{table}"), port) for table in ("udp", "udp6"))
        except OSError as error:
            return error.errno == errno.EADDRINUSE
    return False


def free_port(address: str) -> int:
    """A UDP port that no program of this machine has, at that address, or at all where it is empty or none of ours."""
    for _ in range(_TRIES):
        if not is_taken(address, port := _free(address)):
            break
    return port


def _free(address: str) -> int:
    with socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind((address or ANYWHERE, 0))
        except OSError:
            probe.bind(("", 0))
        return int(probe.getsockname()[1])


def _has_port(table: Path, port: int) -> bool:
    rows = table.read_text().splitlines()[1:] if table.exists() else []
    return any(int(row.split()[1].rpartition(":")[2], 16) == port for row in rows)


def own_addresses() -> set[str]:
    """All of this machine's."""
    return {one.address.partition("%")[0] for rows in psutil.net_if_addrs().values() for one in rows}


def _system() -> str:
    try:
        return platform.freedesktop_os_release().get("PRETTY_NAME", "") or platform.platform()
    except OSError:
        return platform.platform()
