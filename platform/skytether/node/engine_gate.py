"""One connection of an orchestrator to this machine's engine: each request is read, judged, and written anew.

What the engine gets is what was judged, for it gets no byte of the request's head as it came: no second request hides
behind the first, no header asks for another protocol. Answers go back as they are.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import re
import time
from http import HTTPStatus
from typing import Any
from urllib.parse import parse_qsl, unquote, urlencode

from skytether.api.printable import printable
from skytether.api.splice import PIECE, Stream

from .archives import Images, moved, ways
from .engine_rules import NETWORK, NOBODY, OPEN, OWNER, WEIGHED, Call, Subject, judge, plain
from .machine import ask, ask_json
from .registries import Registries

log = logging.getLogger(__name__)

_LINE = re.compile(rb"([A-Z]{3,7}) (/[!-~]{0,8000}) HTTP/1\.1")
_PASSED = (b"accept", b"x-registry-auth")
"""Headers that the engine gets as they are. The type of what is sent is told by us: an engine reads a form, too, and
believes it before the query."""
_MOST_JSON, _MOST_ARCHIVE = 1 << 20, 64 << 20
"""Bytes of a request's body."""
_MOST_DIGITS = 12
"""Of a length."""
_LARGE, _MOST_LARGE, _BODY_S = 1 << 15, 16, 20.0
"""Bytes from which on a body is a large one; so many are held at a time, of all orchestrators; and for how long one may
take to arrive."""
_MARKS = {
    "containers": {OWNER},
    "volumes": {OWNER},
    "networks": {NETWORK},
    "seen networks": {NETWORK, OPEN},
    "joined networks": {NETWORK, OPEN},
}
"""By kind, labels of which one makes a thing ours."""
_KNOWN = 4096
"""Containers that are remembered to be ours."""
_MOST_TOLD, _TOLD_S = 20, 600.0
"""Refusals that are logged within a while: a log has room for others, too."""
_WEIGH_S, _MOST_WEIGHED = 300.0, 32 << 20
"""What an engine may take to say how large all is that it has: seconds, and bytes."""


class RefusedCall(Exception):  # noqa: N818 (an answer)
    """One sentence."""

    def __init__(self, text: str, status: HTTPStatus = HTTPStatus.FORBIDDEN) -> None:
        super().__init__(text)
        self.status = status


class EngineGate:
    """Judges what is asked of one engine."""

    def __init__(self, engine: str, devices: tuple[str, ...] = (), registries: tuple[str, ...] = ()) -> None:
        """Judge by what was said as the machine joined.

        Args:
            engine: Path of its socket.
            devices: Files of devices that containers may have.
            registries: See `Registries`.
        """
        self._engine = engine
        self._registries = Registries(registries)
        self._devices = devices
        self._ours: set[str] = set()
        self._opened: set[str] = set()
        """Containers into whose files the engine may look."""
        self._images = Images(engine)
        self._told: set[str] = set()
        self._told_at = -_TOLD_S
        self._large = asyncio.Semaphore(_MOST_LARGE)
        self._looking, self._weighing = asyncio.Lock(), asyncio.Lock()

    async def pass_requests(self, asks: Stream, engine: Stream) -> None:
        """Until the one who asks has ended, or was refused something."""
        (reader, back), (_, writer) = asks, engine
        try:
            while True:
                await self._pass_one(reader, back, writer)
        except asyncio.IncompleteReadError:
            return  # it has ended
        except (RefusedCall, asyncio.LimitOverrunError) as error:
            status = error.status if isinstance(error, RefusedCall) else HTTPStatus.FORBIDDEN
            text = f"this machine's node refuses it: {error}"
            self._tell(printable(str(error), lines=False))
            body = json.dumps({"message": text}).encode()
            rows = ("Content-Type: application/json", f"Content-Length: {len(body)}", "Connection: close")
            head = "\r\n".join((f"HTTP/1.1 {status.value} {status.phrase}", *rows))
            back.write(f"{head}\r\n\r\n".encode() + body)
            with contextlib.suppress(OSError):
                await back.drain()

    def _tell(self, text: str) -> None:
        """Each once, and a few of them."""
        if time.monotonic() - self._told_at >= _TOLD_S:
            self._told, self._told_at = set(), time.monotonic()
        if text not in self._told and len(self._told) < _MOST_TOLD:
            self._told.add(text)
            more = "; no more is told for some minutes" if len(self._told) == _MOST_TOLD else ""
            log.warning("an orchestrator's call to the engine: %s%s", text, more)

    async def _pass_one(
        self, reader: asyncio.StreamReader, back: asyncio.StreamWriter, writer: asyncio.StreamWriter
    ) -> None:
        head = await reader.readuntil(b"\r\n\r\n")
        first, *rows = head[:-4].split(b"\r\n")
        line = _LINE.fullmatch(first)
        headers = dict(_header(row) for row in rows)
        if line is None or len(headers) != len(rows) or b"transfer-encoding" in headers:
            raise RefusedCall("it is no plain request")
        method, (path, _, asked) = line[1].decode(), line[2].decode().partition("?")
        pairs = parse_qsl(asked, keep_blank_values=True)
        query, length = dict(pairs), headers.get(b"content-length", b"0")
        archive = method == "PUT"
        most = _MOST_ARCHIVE if archive else _MOST_JSON
        if len(query) != len(pairs) or not length.isdigit() or len(length) > _MOST_DIGITS or int(length) > most:
            raise RefusedCall("its query or its length is odd")
        large = not archive and int(length) > _LARGE
        async with self._large if large else contextlib.nullcontext():
            async with asyncio.timeout(_BODY_S):
                body = b"" if archive else await reader.readexactly(int(length))
            try:
                said = json.loads(body) if body else None
            except (ValueError, RecursionError):
                raise RefusedCall("its body is no JSON") from None
            await self._check(Call(method, unquote(path), query, said))
            target = path + (f"?{urlencode(query)}" if query else "")
            if plain(unquote(path)) == WEIGHED:
                await self._weigh(target, back)
                return
            body = b"" if said is None else json.dumps(said).encode()
            left = int(length) if archive else len(body)
            kind = "Content-Type: application/json\r\n" if body else ""
            passed = b"".join(b"%s: %s\r\n" % (name, headers[name]) for name in _PASSED if name in headers)
            head = f"{method} {target} HTTP/1.1\r\nHost: engine\r\nContent-Length: {left}\r\n{kind}".encode()
            writer.write(head + passed + b"\r\n" + body)
            await writer.drain()
        while archive and left:
            piece = await reader.read(min(left, PIECE))
            if not piece:
                raise asyncio.IncompleteReadError(b"", left)
            left -= len(piece)
            writer.write(piece)
            await writer.drain()

    async def _check(self, call: Call) -> None:
        refused, subjects = judge(call, self._devices)
        if refused:
            raise RefusedCall(refused)
        for subject in subjects:
            if subject[0] == "pulled":
                if odd := await self._registries.refusal(subject[1]):
                    raise RefusedCall(odd)
            elif subject[0] == "images":
                await self._may_be_pulled(subject[1])
            elif not await self._is_ours(subject):
                raise RefusedCall(f"{subject[1][:80]} is not of an orchestrator")
        if call.path.endswith("/archive"):
            await self._may_be_opened(subjects[0][1])

    async def _may_be_pulled(self, image: str) -> None:
        """Raises if something else of this machine has that name: who starts it by that name would start ours."""
        status, found = await self._asked(f"/images/{image}/json")
        digests = found.get("RepoDigests") if isinstance(found, dict) else None
        known = {_familiar(str(one).partition("@")[0]) for one in digests or ()}
        if status != HTTPStatus.NOT_FOUND and _familiar(image.rpartition(":")[0]) not in known:
            raise RefusedCall(f"the image {image[:80]} of this machine was not pulled from there")

    async def _may_be_opened(self, container: str) -> None:
        """Raises unless the engine may look into its files."""
        if container in self._opened:
            return
        status, found = await self._asked(f"/containers/{container}/json")
        if status == HTTPStatus.NOT_FOUND:
            return
        if status != HTTPStatus.OK or (refused := moved(found)):
            raise RefusedCall(f"its files are not looked at: {refused if status == HTTPStatus.OK else status}")
        try:
            async with self._looking:
                link = await asyncio.to_thread(self._images.link, str(found["Image"]), ways(found))
        except (OSError, ValueError) as error:
            raise RefusedCall(f"its image is not looked at: {error}", HTTPStatus.SERVICE_UNAVAILABLE) from error
        if link:
            raise RefusedCall(f"its files are not looked at: {link} is a link in its image")
        self._opened = self._opened if len(self._opened) < _KNOWN else set()
        self._opened.add(container)

    async def _weigh(self, target: str, back: asyncio.StreamWriter) -> None:
        """Answer in the engine's place, with what is ours."""
        try:
            async with self._weighing:
                answer = await asyncio.to_thread(ask, self._engine, target, patience=_WEIGH_S, most=_MOST_WEIGHED)
            found = json.loads(answer.content)
            volumes = found.get("Volumes") or (found.get("VolumeUsage") or {}).get("Items") or ()
            ours = [one for one in volumes if OWNER in (one.get("Labels") or ())]
        except (OSError, ValueError, AttributeError, TypeError) as error:
            raise RefusedCall(f"its engine does not answer: {error}", HTTPStatus.SERVICE_UNAVAILABLE) from error
        body = json.dumps({"Volumes": ours}).encode()
        rows = f"HTTP/1.1 200 OK\r\nContent-Type: application/json\r\nContent-Length: {len(body)}\r\n\r\n"
        back.write(rows.encode() + body)
        await back.drain()

    async def _asked(self, path: str) -> tuple[int, Any]:
        try:
            return await asyncio.to_thread(ask_json, self._engine, path)
        except (OSError, ValueError) as error:
            raise RefusedCall(f"its engine does not answer: {error}", HTTPStatus.SERVICE_UNAVAILABLE) from error

    async def _is_ours(self, subject: Subject) -> bool:
        """Whether an orchestrator made it, or there is none: the engine says that itself."""
        kind, name = subject
        if kind == "containers" and name in self._ours:
            return True
        what = kind.rpartition(" ")[2]
        path = f"/{what}/{name}/json" if what == "containers" else f"/{what}/{name}"
        if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]*", name):
            return False
        status, found = await self._asked(path)
        if status == HTTPStatus.NOT_FOUND:
            return kind != "joined networks"
        document = found if isinstance(found, dict) else {}
        config = document.get("Config") if what == "containers" else document
        labels = config.get("Labels") if isinstance(config, dict) else None
        if not isinstance(labels, dict) or not _MARKS[kind] & labels.keys() or labels.get(OWNER) == NOBODY:
            return False
        if what == "containers" and name == document.get("Id"):  # its labels never change
            self._ours = self._ours if len(self._ours) < _KNOWN else set()
            self._ours.add(name)
        return True


def _header(row: bytes) -> tuple[bytes, bytes]:
    name, colon, value = row.partition(b":")
    if not colon or not re.fullmatch(rb"[A-Za-z-]+", name) or not re.fullmatch(rb"[\t -~]*", value):
        raise RefusedCall("it is no plain request")
    return name.lower(), value.strip()


def _familiar(image: str) -> str:
    """A name as an engine shortens it."""
    return re.sub(r"^(?:(?:index\.)?docker\.io/)?(?:library/)?", "", image)
