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
from collections.abc import Awaitable, Callable, Coroutine
from functools import partial
from http import HTTPStatus
from typing import Any, TypeVar
from urllib.parse import parse_qsl, unquote, urlencode

from skytether.api.printable import printable
from skytether.api.splice import PIECE, Stream

from .archives import cleaned
from .asking import JSON, Asking, RefusedCall, begun
from .engine_rules import (
    FOLDER,
    MADE,
    NETWORK,
    NOBODY,
    OPEN,
    OWNER,
    PORT,
    SEEN,
    WEIGHED,
    Call,
    Subject,
    checked,
    judge,
    plain,
    published,
)
from .files import Files
from .joins import BusyError
from .machine import ANYWHERE, Answer, ask_long, free_port, is_taken, listed
from .pulls import AUTH, Pulls
from .registries import Registries
from .removals import Removals
from .store import NodeStore

log = logging.getLogger(__name__)

_T = TypeVar("_T")
_LINE = re.compile(rb"([A-Z]{3,7}) (/[!-~]{0,8000}) HTTP/1\.1")
_PASSED = (b"accept", AUTH)
"""Headers that the engine gets as they are. The type of what is sent is told by us: an engine reads a form, too, and
believes it before the query."""
_MOST_JSON, _MOST_ARCHIVE = 1 << 18, 2 << 20
"""Bytes of a request's body; an archive holds a grant, with what a robot asked for. Of JSON, what was read takes forty
times as much."""
_MOST_DIGITS = 12
"""Of a length."""
_LARGE, _MOST_LARGE, _BODY_S = 1 << 15, 2, 20.0
"""Bytes from which on a body is a large one; so many are held at a time, of each orchestrator; and for how long one may
take to arrive."""
_MARKS = {
    "containers": {OWNER},
    "volumes": {OWNER},
    "networks": {NETWORK},
    "seen networks": {NETWORK, OPEN},
    "joined networks": {NETWORK, OPEN},
    "kept networks": {NETWORK},
}
"""By kind, labels of which one makes a thing ours."""
_KNOWN = 4096
"""Containers that are remembered to be ours."""
_MOST_TOLD, _TOLD_S = 20, 600.0
"""Refusals that are logged within a while: a log has room for others, too."""
_MOST_CREATES = 64
"""Containers that are made at a time."""
_MADE_S, _MOST_NETWORKS = 60.0, 12
"""For a network to be made [s], and how many of ours there are: an engine has room for 31 in all, and whoever could
take them all has addresses that the machine knows elsewhere."""
_MOST_DESCRIBED = 64 << 10
"""Bytes of what an engine says of one container."""
_MAKES, _PULL = ("/containers/create", "/volumes/create"), "/images/create"
_LOOK_AGAIN_S = 5.0
"""Before the engine is asked again what was there as this program started, where it did not say."""
_END_S = 60.0
"""What an engine may take to end a container, or to change what it may have [s]."""
_WEIGH_S = 300.0
"""What an engine may take to say how large all is that it has [s]."""
_MOST_WEIGHS, _TAKEN_S = 2, 10.0
"""Ways of each orchestrator that are told that at a time, and for how long each may take to take it [s]."""
_WEIGH = f"{WEIGHED}?type=volume&verbose=1"
"""As newer engines are asked it; an earlier one tells all."""
_WEIGHED, _OWNED, _SIZE = ("Volumes.item", "VolumeUsage.Items.item"), f"Labels.{OWNER}", "UsageData.Size"


class Places:
    """What one link may have of what takes memory."""

    def __init__(self) -> None:
        self.large = asyncio.Semaphore(_MOST_LARGE)
        """For bodies."""
        self.weighs = asyncio.Semaphore(_MOST_WEIGHS)


class EngineGate:
    """Judges what is asked of one engine."""

    def __init__(
        self,
        engine: str,
        devices: tuple[str, ...] = (),
        registries: tuple[str, ...] = (),
        store: NodeStore | None = None,
    ) -> None:
        """Judge by what was said as the machine joined.

        Args:
            engine: Path of its socket.
            devices: Files of devices that containers may have.
            registries: See `Registries`.
            store: Where it is kept what orchestrators call images; None: nowhere.
        """
        self._engine = engine
        self._devices = devices
        self._ours: set[str] = set()
        self._removals = Removals(engine)
        self._told: set[str] = set()
        self._told_at = -_TOLD_S
        self._weighing: asyncio.Task[bytes] | None = None
        self._making = asyncio.Lock()
        self._creates = asyncio.Semaphore(_MOST_CREATES)
        asking = Asking(engine)
        self._ask, self._asked = asking.ask, asking.asked
        self._files = Files(engine, asking)
        names, keep = (store.names(), store.save_names) if store else ({}, lambda _: None)
        self._pulls = Pulls(asking, Registries(registries), names, keep)

    async def look_back(self) -> None:
        """Once: have what an earlier program of the node left paused go on, as soon as the engine answers."""
        while True:
            try:
                return await self._removals.look_back()
            except (OSError, ValueError):
                await asyncio.sleep(_LOOK_AGAIN_S)

    def of_link(self) -> Callable[[Stream, Stream], Coroutine[Any, Any, None]]:
        """What passes requests on that come by one link: what is large of one waits for no other's."""
        return partial(self.pass_requests, places=Places())

    async def pass_requests(self, asks: Stream, engine: Stream, places: Places) -> None:
        """Until the one who asks has ended, or was refused something; ``places``: its link's."""
        (reader, back), (_, writer) = asks, engine
        try:
            while True:
                await self._pass_one(reader, back, writer, places)
        except asyncio.IncompleteReadError:
            return  # it has ended
        except (RefusedCall, asyncio.LimitOverrunError) as error:
            status = error.status if isinstance(error, RefusedCall) else HTTPStatus.FORBIDDEN
            gone = status == HTTPStatus.NOT_FOUND
            text = str(error) if gone else f"this machine's node refuses it: {error}"
            if not gone:
                self._warn_once(printable(str(error), lines=False))
            with contextlib.suppress(OSError):
                await _answer(back, status, json.dumps({"message": text}).encode(), f"{JSON}\r\nConnection: close")

    def _warn_once(self, text: str) -> None:
        """Each once, and a few of them."""
        if time.monotonic() - self._told_at >= _TOLD_S:
            self._told, self._told_at = set(), time.monotonic()
        if text not in self._told and len(self._told) < _MOST_TOLD:
            self._told.add(text)
            more = "; no more is told for some minutes" if len(self._told) == _MOST_TOLD else ""
            log.warning("an orchestrator's call to the engine: %s%s", text, more)

    async def _pass_one(
        self,
        reader: asyncio.StreamReader,
        back: asyncio.StreamWriter,
        writer: asyncio.StreamWriter,
        places: Places,
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
        most = _MOST_ARCHIVE if archive else _MOST_JSON if plain(path) == _MAKES[0] else _LARGE
        if len(query) != len(pairs) or not length.isdigit() or len(length) > _MOST_DIGITS or int(length) > most:
            raise RefusedCall("its query or its length is odd")
        async with places.large if int(length) > _LARGE else contextlib.nullcontext():
            # All of it, an archive too: an engine that waits for the rest of one lets nobody end that container.
            async with asyncio.timeout(_BODY_S):
                body = await reader.readexactly(int(length))
            try:
                said = json.loads(body) if body and not archive else None
            except (ValueError, RecursionError):
                raise RefusedCall("its body is no JSON") from None
            call = Call(method, unquote(path), query, said)
            await self._check(call)
            if archive:
                made = cleaned(body, query["path"])
                if made is None:
                    raise RefusedCall("its archive has something else than folders of ours and a grant")
                body = made
            if plain(call.path) == _PULL:
                query["tag"] = await self._pulls.digest_of(query["fromImage"], query["tag"], headers)
            path = await self._pulls.path_of(path)
            target = path + (f"?{urlencode(query)}" if query else "")
            if plain(call.path) == WEIGHED:
                async with places.weighs:
                    await self._weigh(back)
                return
            if answered := self._answered(call, path, target, body if archive else b""):
                await _answer(back, *await answered)
                return
            if not archive:
                body = b"" if said is None else json.dumps(said).encode()
            kind = "Content-Type: application/json\r\n" if body and not archive else ""
            passed = b"".join(b"%s: %s\r\n" % (name, headers[name]) for name in _PASSED if name in headers)
            head = f"{method} {target} HTTP/1.1\r\nHost: engine\r\nContent-Length: {len(body)}\r\n{kind}".encode()
            writer.write(head + passed + b"\r\n" + body)
            await writer.drain()

    def _answered(self, call: Call, way: str, target: str, archive: bytes) -> Awaitable[tuple[int, bytes, str]] | None:
        """What is asked of the engine by us, who then answer in its place; None: it answers itself.

        Args:
            call: What is asked.
            way: Its path, as it was written.
            target: With the query.
            archive: That is put into a container.
        """
        path = plain(call.path)
        _, kind, name = (*path.split("/"), "", "")[:3]
        if path == MADE:
            return asyncio.shield(begun(self._make(target, call.body)))
        if path == _MAKES[0]:
            return asyncio.shield(begun(self._create(target, call.body)))  # looked at, whoever waits for it
        if SEEN.fullmatch(path) and call.method == "GET":
            return self._network(target)
        if path.endswith("/archive") and call.method == "GET":
            return self._files.read(name, call.query["path"])
        if path.endswith("/archive") and call.method == "HEAD":
            return self._files.stat(name, call.query["path"], target)
        if path.endswith("/archive") and call.method == "PUT":
            return self._put(name, target, archive, call.query["path"])
        if kind == "containers" and path.endswith("/start"):
            return self._start(name, target)
        if call.method == "DELETE" and kind == "volumes":
            return self._kept(self._removals.remove_volume(name, target))
        if call.method == "DELETE" and kind == "containers":
            rest = urlencode({key: value for key, value in call.query.items() if key != "v"})
            if "v" in call.query:
                removes = partial(self._removals.remove_container, name, f"{way}?{rest}")
                return self._kept(self._removals.end(name, removes))
            return self._kept(self._removals.end(name, partial(self._ask, target, method="DELETE", patience=_END_S)))
        if kind == "containers" and path.endswith(("/kill", "/update")):
            asks = partial(self._ask, target, method="POST", patience=_END_S, body=call.body)
            return self._kept(self._removals.end(name, asks))
        return None

    async def _check(self, call: Call) -> None:
        refused, subjects = judge(call, self._devices)
        if refused:
            raise RefusedCall(refused)
        for subject in subjects:
            if subject[0] == "pulled":
                await self._pulls.may_come_from(subject[1])
            elif subject[0] == "guarded":
                await self._may_be_guarded(subject[1])
            elif not await self._is_ours(subject):
                raise RefusedCall(f"{subject[1][:80]} is not of an orchestrator")
        if call.path.endswith("/archive") and call.method == "PUT":
            await self._files.may_be_opened(subjects[0][1])
        elif plain(call.path) in _MAKES:
            await self._tried(self._removals.look_back())
        elif plain(call.path).endswith("/connect"):
            _may_be_published((await self._asked(f"/containers/{subjects[0][1]}/json"))[1])

    async def _may_be_guarded(self, container: str) -> None:
        """Raises unless the network that it is made in is ours, and it is connected to no other but ours after that.

        Who has a guard's right in a network takes others' addresses there.
        """
        found = (await self._asked(f"/containers/{container}/json"))[1]
        mode = str((found.get("HostConfig") or {}).get("NetworkMode"))
        if not await self._is_ours(("kept networks", mode)):
            raise RefusedCall(f"no guard has a right in {mode[:80]}, which no orchestrator made")

    async def _may_be_started(self, container: str) -> Any:
        """What the engine says of it; raises unless its networks are ours still: by their names it is connected.

        And the engine looks into its files: it mounts its volumes, and reads who it is.
        """
        status, found = await self._asked(f"/containers/{container}/json")
        if status != HTTPStatus.OK:
            raise RefusedCall(f"No such container: {container}", HTTPStatus.NOT_FOUND)
        if odd := checked((found.get("Config") or {}).get("Healthcheck")):
            raise RefusedCall(odd)
        _may_be_published(found)
        mode = str((found.get("HostConfig") or {}).get("NetworkMode"))
        for name in sorted({*((found.get("NetworkSettings") or {}).get("Networks") or ()), mode}):
            if not name.startswith("container:") and not await self._is_ours(("joined networks", name)):
                if (await self._asked(f"/networks/{name}"))[0] == HTTPStatus.NOT_FOUND:
                    raise RefusedCall(f"network {name} not found", HTTPStatus.NOT_FOUND)
                raise RefusedCall(f"{name[:80]} is not of an orchestrator")
        await self._files.may_be_opened(container)
        return found

    async def _start(self, container: str, target: str) -> tuple[int, bytes, str]:
        return await self._kept(self._removals.start(container, await self._may_be_started(container), target))

    async def _put(self, container: str, target: str, archive: bytes, where: str) -> tuple[int, bytes, str]:
        own = FOLDER if where == FOLDER else ""  # elsewhere there are folders only
        done = await self._tried(self._removals.put(container, target, archive, own))
        if done is None:
            own = f", a grant into a volume at {FOLDER} that has no name"
            raise RefusedCall(f"what is put into a container is put there before it was ever started{own}")
        return done.status, done.content, JSON

    async def _kept(self, answer: Awaitable[Answer]) -> tuple[int, bytes, str]:
        """Of what was started or removed."""
        done = await self._tried(answer)
        return done.status, done.content, JSON

    async def _tried(self, work: Awaitable[_T]) -> _T:
        try:
            return await work
        except BusyError as error:
            raise RefusedCall(str(error), HTTPStatus.SERVICE_UNAVAILABLE) from error
        except (OSError, ValueError) as error:
            raise RefusedCall(f"its engine does not answer: {error}", HTTPStatus.SERVICE_UNAVAILABLE) from error

    async def _create(self, target: str, said: Any) -> tuple[int, bytes, str]:
        """A container, at a port that is free, if its description is not large.

        An engine tries one after the other, and meanwhile leads there what comes for the machine's own programs. And it
        tells all of a description, with all others, in each list.
        """
        found = ((said.get("HostConfig") or {}).get("PortBindings") or {}).get(PORT)
        for bound in found if isinstance(found, list) else ():
            bound["HostPort"] = bound.get("HostPort") or str(free_port(bound.get("HostIp") or ""))
        text = json.dumps(said).encode()
        del said, found  # of what was read Python keeps twelve times as much
        if self._creates.locked():
            raise RefusedCall("too many containers are being made", HTTPStatus.SERVICE_UNAVAILABLE)
        async with self._creates:  # however long it takes
            answer = await self._tried(ask_long(self._engine, target, method="POST", body=text))
        if answer.status == HTTPStatus.CREATED:
            made = json.loads(answer.content)["Id"]
            try:
                await self._must_be_brief(made)
            except RefusedCall:
                removes = partial(self._removals.remove_container, made, f"/containers/{made}?force=1")
                await self._tried(self._removals.end(made, removes))  # it may run by now
                raise
        return answer.status, answer.content, JSON

    async def _must_be_brief(self, container: str) -> None:
        """Raises if what the engine says of it is large, or cannot be known."""
        described = await self._ask(f"/containers/{container}/json", patience=_END_S, most=_MOST_DESCRIBED + 1)
        if len(described.content) > _MOST_DESCRIBED:
            raise RefusedCall(f"its description has more than {_MOST_DESCRIBED >> 10} KiB, with what its image says")

    async def _make(self, target: str, said: Any) -> tuple[int, bytes, str]:
        """A network, unless there are many of ours."""
        async with self._making:
            status, found = await self._asked(f"/networks?{urlencode({'filters': json.dumps({'label': [NETWORK]})})}")
            if status != HTTPStatus.OK or len(found) >= _MOST_NETWORKS:
                raise RefusedCall(f"orchestrators made {_MOST_NETWORKS} networks here, as many as they may")
            answer = await self._ask(target, method="POST", patience=_MADE_S, body=said)
        return answer.status, answer.content, JSON

    async def _network(self, target: str) -> tuple[int, bytes, str]:
        """One that is open has containers of the machine's owner, too: nothing of them."""
        status, found = await self._asked(target)
        if isinstance(found, dict):
            found = {key: value for key, value in found.items() if key not in ("Containers", "Peers", "Services")}
        return status, json.dumps(found).encode(), JSON

    async def _weigh(self, back: asyncio.StreamWriter) -> None:
        """Tell of what there is what is ours. It may be much: there is one look at a time, for all who ask."""
        if self._weighing is None or self._weighing.done():
            self._weighing = begun(self._tried(self._weigh_all()))
        async with asyncio.timeout(_WEIGH_S):
            told = await asyncio.shield(self._weighing)
        async with asyncio.timeout(_TAKEN_S):
            await _answer(back, HTTPStatus.OK, told, JSON)

    async def _weigh_all(self) -> bytes:
        keys = ("Name", _OWNED, _SIZE)
        there = await asyncio.to_thread(listed, self._engine, _WEIGH, _WEIGHED, keys, patience=_WEIGH_S)
        there.reverse()
        said = bytearray()
        while there:  # let go of one by one, for it may be much
            name, owner, size = map(there.pop().get, keys)
            if isinstance(name, str) and isinstance(owner, str) and name.isascii() and owner.isascii():
                one = {"Name": name, "Labels": {OWNER: owner}, "UsageData": {"Size": size}}
                said += (b", " if said else b"") + json.dumps(one).encode()
        return b'{"Volumes": [' + bytes(said) + b"]}"

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
            return kind not in ("joined networks", "kept networks")
        document = found if isinstance(found, dict) else {}
        config = document.get("Config") if what == "containers" else document
        labels = config.get("Labels") if isinstance(config, dict) else None
        if not isinstance(labels, dict) or not _MARKS[kind] & labels.keys() or labels.get(OWNER) == NOBODY:
            return False
        if what == "containers" and name == document.get("Id"):  # its labels never change
            self._ours = self._ours if len(self._ours) < _KNOWN else set()
            self._ours.add(name)
        return True


def _may_be_published(inspected: Any) -> None:
    """Raises if a program of this machine has the UDP port that a container is to be published at.

    An engine (20.10) first leads there what comes for it, and only then finds that it is taken.
    """
    if ((inspected.get("NetworkSettings") or {}).get("Ports") or {}).get(PORT):
        return  # it has it already
    for bound in ((inspected.get("HostConfig") or {}).get("PortBindings") or {}).get(PORT) or ():
        if refused := published(bound):
            raise RefusedCall(refused)
        address, port = bound.get("HostIp") or "", bound.get("HostPort")
        if not port:
            raise RefusedCall("it was made by an earlier release, and is published at whatever port: make it anew")
        if is_taken(address, int(port)):
            raise RefusedCall(f"UDP port {port} of {address or ANYWHERE}: address already in use")


async def _answer(back: asyncio.StreamWriter, status: int, body: bytes, rows: str) -> None:
    """``rows``: more of its head."""
    head = f"HTTP/1.1 {int(status)} {HTTPStatus(status).phrase}\r\nContent-Length: {len(body)}\r\n{rows}\r\n\r\n"
    back.write(head.encode())
    for start in range(0, len(body), PIECE):  # a connection keeps what it does not take
        back.write(body[start : start + PIECE])
        await back.drain()


def _header(row: bytes) -> tuple[bytes, bytes]:
    name, colon, value = row.partition(b":")
    if not colon or not re.fullmatch(rb"[A-Za-z-]+", name) or not re.fullmatch(rb"[\t -~]*", value):
        raise RefusedCall("it is no plain request")
    return name.lower(), value.strip()
