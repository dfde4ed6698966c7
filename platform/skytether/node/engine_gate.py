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
from http import HTTPStatus
from urllib.parse import parse_qsl, unquote, urlencode

from skytether.api.splice import PIECE, Stream

from .engine_rules import NETWORK, OPEN, OWNER, Call, Subject, judge
from .machine import ask_json

log = logging.getLogger(__name__)

_LINE = re.compile(rb"([A-Z]{3,7}) (/[!-~]{0,8000}) HTTP/1\.1")
_PASSED = (b"accept", b"content-type", b"x-registry-auth")
"""Headers that the engine gets as they are."""
_MOST_JSON, _MOST_ARCHIVE = 1 << 20, 64 << 20
"""Bytes of a request's body."""
_MOST_DIGITS = 12
"""Of a length."""
_MARKS = {"containers": {OWNER}, "volumes": {OWNER}, "networks": {NETWORK}, "joined networks": {NETWORK, OPEN}}
"""By kind, labels of which one makes a thing ours."""
_KNOWN = 4096
"""Containers that are remembered to be ours."""


class RefusedCall(Exception):  # noqa: N818 (an answer)
    """One sentence."""

    def __init__(self, text: str, status: HTTPStatus = HTTPStatus.FORBIDDEN) -> None:
        super().__init__(text)
        self.status = status


class EngineGate:
    """Judges what is asked of one engine."""

    def __init__(self, engine: str, devices: tuple[str, ...]) -> None:
        """``engine``: path of its socket; ``devices``: what containers may have."""
        self._engine = engine
        self._devices = devices
        self._ours: set[str] = set()
        self._told: set[str] = set()

    async def pass_requests(self, asks: Stream, engine: Stream) -> None:
        """Until the one who asks has ended, or was refused something."""
        (reader, back), (_, writer) = asks, engine
        try:
            while True:
                await self._pass_one(reader, writer)
        except asyncio.IncompleteReadError:
            return  # it has ended
        except (RefusedCall, asyncio.LimitOverrunError) as error:
            status = error.status if isinstance(error, RefusedCall) else HTTPStatus.FORBIDDEN
            text = f"this machine's node refuses it: {error}"
            if text not in self._told:
                self._told = {*list(self._told)[-99:], text}
                log.warning("an orchestrator's call to the engine: %s", error)
            body = json.dumps({"message": text}).encode()
            rows = ("Content-Type: application/json", f"Content-Length: {len(body)}", "Connection: close")
            head = "\r\n".join((f"HTTP/1.1 {status.value} {status.phrase}", *rows))
            back.write(f"{head}\r\n\r\n".encode() + body)
            with contextlib.suppress(OSError):
                await back.drain()

    async def _pass_one(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
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
        body = b"" if archive else await reader.readexactly(int(length))
        try:
            said = json.loads(body) if body else None
        except (ValueError, RecursionError):
            raise RefusedCall("its body is no JSON") from None
        refused, subjects = judge(Call(method, unquote(path), query, said), self._devices)
        if refused:
            raise RefusedCall(refused)
        for subject in subjects:
            if not await self._is_ours(subject):
                raise RefusedCall(f"{subject[1][:80]} is not of an orchestrator")
        body = json.dumps(said).encode() if body else body
        left = int(length) if archive else len(body)
        passed = b"".join(b"%s: %s\r\n" % (name, headers[name]) for name in _PASSED if name in headers)
        target = path + (f"?{urlencode(query)}" if query else "")
        writer.write(f"{method} {target} HTTP/1.1\r\nHost: engine\r\nContent-Length: {left}\r\n".encode())
        writer.write(passed + b"\r\n" + body)
        while archive and left:
            piece = await reader.read(min(left, PIECE))
            if not piece:
                raise asyncio.IncompleteReadError(b"", left)
            left -= len(piece)
            writer.write(piece)
            await writer.drain()
        await writer.drain()

    async def _is_ours(self, subject: Subject) -> bool:
        """Whether an orchestrator made it, or there is none: the engine says that itself."""
        kind, name = subject
        if name in self._ours:
            return True
        what = kind.rpartition(" ")[2]
        path = f"/{what}/{name}/json" if what == "containers" else f"/{what}/{name}"
        if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]*", name):
            return False
        try:
            status, found = await asyncio.to_thread(ask_json, self._engine, path)
        except (OSError, ValueError) as error:
            raise RefusedCall(f"its engine does not answer: {error}", HTTPStatus.SERVICE_UNAVAILABLE) from error
        if status == HTTPStatus.NOT_FOUND:
            return what == kind
        document = found if isinstance(found, dict) else {}
        config = document.get("Config") if what == "containers" else document
        labels = config.get("Labels") if isinstance(config, dict) else None
        if not isinstance(labels, dict) or not _MARKS[kind] & labels.keys():
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
