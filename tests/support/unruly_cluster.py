"""An API server of Kubernetes, with nodes, that is made up and keeps to no more than it must.

Over real sockets, in a thread of its own. It keeps to the contract of the real one (versions, watches that go on where
a list ended, preconditions, grace, collection by owner), and its `regime` says how it misbehaves meanwhile. It judges
by itself what runs: two runs of one instance at a time, of which nobody ends the first, are noted in `doubles`.
"""

from __future__ import annotations

import asyncio
import json
import random
import threading
import time
import uuid
from collections import Counter, deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from http import HTTPStatus
from typing import Any, TypeVar
from urllib.parse import parse_qsl, urlsplit

Document = dict[str, Any]
T = TypeVar("T")
_INSTANCE, _ATTEMPT = "skytether.io/instance", "skytether.io/attempt"
_NODES = 4
_BOOKMARK_S = 1.0
_PATIENCE_S = 30.0


@dataclass(frozen=True)
class Regime:
    """How it misbehaves. Chances are of each call, but for those of a watch, which are of each event."""

    name: str = "calm"
    only: str = ""
    """With which calls begin that bear the chances: ``POST pods``."""
    cut_before: float = 0.0
    """The connection is cut, and nothing was done."""
    cut_after: float = 0.0
    """It was done, and its answer is lost."""
    status: int = 0
    refuses: float = 0.0
    """Answers ``status``."""
    late: float = 0.0
    """It is done late, or answered late."""
    late_s: float = 4.0
    dead: bool = False
    """Whoever connects is cut off."""
    event_late_s: float = 0.0
    twice: float = 0.0
    shuffled: bool = False
    lost: float = 0.0
    """An event is never told; that watch ends with 410 soon."""
    mute: bool = False
    """Watches tell of bookmarks only."""


CALM = Regime()
REGIMES = (
    Regime("answers lost", cut_after=0.4),
    Regime("calls lost", cut_before=0.4),
    Regime("500", status=500, refuses=0.5),
    Regime("503", status=503, refuses=0.9),
    Regime("429", status=429, refuses=0.8),
    Regime("late", late=0.3),
    Regime("dead", dead=True),
    Regime("events late", event_late_s=3.0),
    Regime("events odd", twice=0.4, shuffled=True, event_late_s=0.5),
    Regime("events lost", lost=0.4),
    Regime("mute", mute=True),
    Regime("all", cut_after=0.1, cut_before=0.1, late=0.1, late_s=2.0, twice=0.2, event_late_s=1.0, lost=0.1),
)


@dataclass
class Run:
    """A pod's container, or what will be one."""

    pod: str
    uid: str
    instance: str
    attempt: int
    began: float = 0.0
    """When its Secret came; 0: never."""
    at_work: bool = False
    """Its container runs."""
    ending: float = 0.0
    """Since when somebody ends it."""
    over: bool = False


@dataclass
class _Watcher:
    """Of the pods of a namespace."""

    namespace: str
    kind: str
    events: asyncio.Queue[tuple[str, int, bytes]] = field(default_factory=asyncio.Queue)


class UnrulyCluster:
    """Use within ``running``. What has no underscore may be called from any thread."""

    def __init__(self, seed: int, *, fails: float = 0.0, pace: float = 1.0) -> None:
        """``fails``: the chance of a run to fail at once; ``pace``: how quick its nodes are, beside real ones."""
        self.regime = CALM
        self.fails = fails
        self._pace = pace
        self.minor = 33
        """Of its version; `pods/resize` is there from 33 on."""
        self.no_room = ""
        """How nodes answer who is to have more: ``Infeasible`` or ``Deferred``; empty: they give it."""
        self.runs: dict[str, Run] = {}
        """By uid of their pod, all that there ever were."""
        self.doubles: list[str] = []
        self.overlaps: list[float] = []
        """Seconds for which two runs of an instance ran while the first one ended."""
        self.calls: deque[tuple[float, str]] = deque()
        """When, and what for."""
        self._rng = random.Random(seed)
        self._objects: dict[tuple[str, str], dict[str, Document]] = {}
        self._version = 100
        self._history: list[tuple[int, str, str, str, bytes]] = []
        """Version, namespace, kind, type and description of all events that can be told of."""
        self._oldest = 100
        self._watchers: list[_Watcher] = []
        self._writers: set[asyncio.StreamWriter] = set()
        self._loop = asyncio.new_event_loop()
        self._held: dict[str, asyncio.Event] = {}
        """Pods whose nodes hang."""
        self.port = 0
        self._server: asyncio.Server

    # From any thread

    @contextmanager
    def running(self) -> Iterator[str]:
        """Its address."""
        thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        thread.start()
        try:
            _: object = self.do(self._open)
            yield self.address
        finally:
            _ = self.do(self._close)
            self._loop.call_soon_threadsafe(self._loop.stop)
            thread.join()
            self._loop.close()

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def do(self, what: Callable[[], T]) -> T:
        """In its own thread."""

        async def done() -> T:
            answer = what()
            return await answer if asyncio.iscoroutine(answer) else answer  # type: ignore[no-any-return]

        return asyncio.run_coroutine_threadsafe(done(), self._loop).result(_PATIENCE_S)

    def objects(self, kind: str) -> list[Document]:
        """Of all namespaces."""
        return self.do(
            lambda: [
                json.loads(json.dumps(o)) for (_, k), them in self._objects.items() if k == kind for o in them.values()
            ]
        )

    def restart(self) -> None:
        """All connections are cut."""
        self.do(self._cut_all)

    def compact(self) -> None:
        """Forget all events: who follows from before gets 410."""

        def compact() -> None:
            self._oldest = self._version + 1
            self._history.clear()
            for watcher in self._watchers:
                watcher.events.put_nowait(("ERROR", 0, b""))

        self.do(compact)

    def remove_one(self, kind: str, *, grace_s: int | None = None) -> None:
        """Somebody deletes something of a kind."""

        def remove() -> None:
            found = [(ns, name) for (ns, k), them in self._objects.items() if k == kind for name in them]
            if found:
                ns, name = self._rng.choice(found)
                self._delete(ns, kind, name, {} if grace_s is None else {"gracePeriodSeconds": grace_s})

        self.do(remove)

    def hold(self, uid: str) -> None:
        """The node of this pod hangs: what it is told to end goes on until it is let go."""
        self._held[uid] = asyncio.Event()

    def let_go(self, uid: str) -> None:
        self._held.pop(uid).set()

    def begun(self) -> dict[str, list[Run]]:
        """What runs, or will as soon as it can, by instance."""
        found: dict[str, list[Run]] = {}
        for run in list(self.runs.values()):
            if run.began and not run.over and not run.ending:
                found.setdefault(run.instance, []).append(run)
        return found

    def most_calls(self) -> tuple[int, Counter[str]]:
        """In any second: how many, and of what."""
        most, window, worst = 0, deque[tuple[float, str]](), Counter[str]()
        for call in list(self.calls):
            window.append(call)
            while window[0][0] <= call[0] - 1.0:
                window.popleft()
            if len(window) > most:
                most, worst = len(window), Counter(what for _, what in window)
        return most, worst

    # Objects

    def _of(self, namespace: str, kind: str) -> dict[str, Document]:
        return self._objects.setdefault((namespace, kind), {})

    def _changed(self, namespace: str, kind: str, document: Document, event: str) -> None:
        self._version += 1
        document["metadata"]["resourceVersion"] = str(self._version)
        line = json.dumps({"type": event, "object": document}).encode() + b"\n"
        self._history.append((self._version, namespace, kind, event, line))
        for watcher in self._watchers:
            if (watcher.namespace, watcher.kind) == (namespace, kind):
                watcher.events.put_nowait((event, self._version, line))

    def _create(self, namespace: str, kind: str, document: Document) -> Document | None:
        meta, there = document["metadata"], self._of(namespace, kind)
        if meta["name"] in there:
            return None
        meta |= {
            "uid": str(uuid.UUID(int=self._rng.getrandbits(128))),
            "creationTimestamp": _now(),
            "namespace": namespace,
        }
        if kind == "services":
            document["spec"]["ports"][0]["nodePort"] = self._rng.randrange(30000, 32768)
        there[meta["name"]] = document
        if kind == "pods":
            document["status"] = {"phase": "Pending"}
            labels = meta["labels"]
            self.runs[meta["uid"]] = Run(meta["name"], meta["uid"], labels[_INSTANCE], int(labels[_ATTEMPT]))
            self._loop.create_task(self._live(namespace, meta["name"], meta["uid"]))
        self._changed(namespace, kind, document, "ADDED")
        if kind == "secrets" and (pod := self._of(namespace, "pods").get(meta["name"])):
            self._begin(self.runs[pod["metadata"]["uid"]])
        for owner in meta.get("ownerReferences") or ():
            if owner["uid"] not in {p["metadata"]["uid"] for p in self._of(namespace, "pods").values()}:
                self._collect(namespace, owner["uid"])
        return document

    def _begin(self, run: Run) -> None:
        if run.began or run.over:
            return
        run.began = time.monotonic()
        for other in self.runs.values():
            if (
                other.instance == run.instance
                and other is not run
                and other.began
                and not other.over
                and not other.ending
            ):
                self.doubles.append(
                    f"{run.instance}: attempt {run.attempt} begun beside {other.attempt} ({other.uid[:8]})"
                )

    def _pod(self, namespace: str, name: str, uid: str) -> Document | None:
        pod = self._of(namespace, "pods").get(name)
        return pod if pod is not None and pod["metadata"]["uid"] == uid else None

    async def _live(self, namespace: str, name: str, uid: str) -> None:
        """A pod's life on its node."""
        rng, run = self._rng, self.runs[uid]
        await asyncio.sleep(rng.uniform(0.01, 0.1) / self._pace)
        pod = self._pod(namespace, name, uid)
        if pod is None:
            run.over = True
            return
        pod["spec"]["nodeName"] = f"node-{rng.randrange(_NODES)}"
        pod["status"]["hostIP"] = "10.0.0.1"
        self._changed(namespace, "pods", pod, "MODIFIED")
        while name not in self._of(namespace, "secrets"):
            await asyncio.sleep(0.1 / self._pace)
            pod = self._pod(namespace, name, uid)
            if pod is None or run.over:
                run.over = True
                return
        self._begin(run)
        await asyncio.sleep(rng.uniform(0.1, 0.6) / self._pace)
        pod = self._pod(namespace, name, uid)
        if pod is None or run.over or run.ending:
            return
        run.at_work = True
        has = pod["spec"]["containers"][0]["resources"]
        status = {**_container(started=False), "resources": json.loads(json.dumps(has))}
        pod["status"] |= {"phase": "Running", "podIP": "10.1.0.1", "containerStatuses": [status]}
        self._changed(namespace, "pods", pod, "MODIFIED")
        if rng.random() < self.fails:
            await asyncio.sleep(rng.uniform(0.05, 0.5) / self._pace)
            self._ended(namespace, name, uid, "Error")
            return
        await asyncio.sleep(rng.uniform(0.1, 0.4) / self._pace)
        pod = self._pod(namespace, name, uid)
        if pod is not None and not run.over and not run.ending:
            pod["status"]["containerStatuses"][0] |= _container(started=True)
            self._changed(namespace, "pods", pod, "MODIFIED")

    def _ended(self, namespace: str, name: str, uid: str, reason: str) -> None:
        run = self.runs[uid]
        if run.over:
            return
        run.over, run.at_work = True, False
        for other in self.runs.values():
            if other.instance == run.instance and other is not run and other.began and other.at_work:
                self.overlaps.append(time.monotonic() - max(other.began, run.began))
        if (pod := self._pod(namespace, name, uid)) is None:
            return
        over = {"exitCode": 143, "finishedAt": _now(), "reason": "Error"}
        told = {"name": "service", "ready": False, "started": False, "state": {"terminated": over}}
        pod["status"] |= {"phase": "Failed", "containerStatuses": [told]}
        if reason == "DeadlineExceeded":
            pod["status"]["reason"] = reason
        self._changed(namespace, "pods", pod, "MODIFIED")

    def _stop(self, namespace: str, pod: Document, within_s: float, reason: str, *, remove: bool) -> None:
        """SIGTERM, and SIGKILL ``within_s`` later."""
        meta = pod["metadata"]
        name, uid = meta["name"], meta["uid"]
        run = self.runs[uid]
        run.ending = run.ending or time.monotonic()

        async def stop() -> None:
            if held := self._held.get(uid):
                await held.wait()
            takes = 0.0 if run.over else self._rng.choice([min(within_s, 0.2), within_s])
            await asyncio.sleep(takes + self._rng.uniform(0.05, 0.4) / self._pace)
            self._ended(namespace, name, uid, reason)
            if remove and self._pod(namespace, name, uid):
                await asyncio.sleep(self._rng.uniform(0.0, 0.3) / self._pace)
                if self._pod(namespace, name, uid):
                    self._drop(namespace, "pods", name)

        self._loop.create_task(stop())

    def _drop(self, namespace: str, kind: str, name: str) -> None:
        document = self._of(namespace, kind).pop(name)
        self._changed(namespace, kind, document, "DELETED")
        if kind == "pods":
            self._collect(namespace, document["metadata"]["uid"])

    def _collect(self, namespace: str, owner: str) -> None:
        """What belonged to a pod that is gone goes later."""

        def collect() -> None:
            for (ns, kind), them in list(self._objects.items()):
                for name, one in list(them.items()):
                    if ns == namespace and owner in [o["uid"] for o in one["metadata"].get("ownerReferences") or ()]:
                        self._drop(ns, kind, name)

        self._loop.call_later(self._rng.uniform(0.3, 3.0) / self._pace, collect)

    def _delete(self, namespace: str, kind: str, name: str, options: Document) -> tuple[int, Document]:
        there = self._of(namespace, kind).get(name)
        if there is None:
            return _status(404, "NotFound", f'{kind} "{name}" not found')
        meta = there["metadata"]
        if (wanted := (options.get("preconditions") or {}).get("uid")) and wanted != meta["uid"]:
            return _status(409, "Conflict", f"the uid in the precondition ({wanted}) is not that of {name}")
        if kind != "pods":
            self._drop(namespace, kind, name)
            return 200, {"kind": "Status", "status": "Success"}
        grace = options.get("gracePeriodSeconds", there["spec"].get("terminationGracePeriodSeconds", 30))
        if not there["spec"].get("nodeName") or grace == 0:
            self._stop(namespace, there, 0.0, "Error", remove=False)
            self._drop(namespace, kind, name)
        elif "deletionTimestamp" not in meta or grace < meta["deletionGracePeriodSeconds"]:
            meta |= {"deletionTimestamp": _now(), "deletionGracePeriodSeconds": grace}
            self._changed(namespace, kind, there, "MODIFIED")
            self._stop(namespace, there, grace, "Error", remove=True)
        return 200, there

    def _merge(self, namespace: str, kind: str, name: str, body: Document) -> tuple[int, Document]:
        there = self._of(namespace, kind).get(name)
        if there is None:
            return _status(404, "NotFound", f'{kind} "{name}" not found')
        if body["metadata"].get("uid", there["metadata"]["uid"]) != there["metadata"]["uid"]:
            return _status(409, "Conflict", "Precondition failed: UID in precondition")
        there["metadata"].setdefault("annotations", {}).update(body["metadata"].get("annotations", {}))
        there["spec"] |= body["spec"]
        self._changed(namespace, kind, there, "MODIFIED")
        self.runs[there["metadata"]["uid"]].ending = time.monotonic()
        self._loop.call_later(
            self._rng.uniform(0.1, 1.0), lambda: self._stop(namespace, there, 1.0, "DeadlineExceeded", remove=False)
        )
        return 200, there

    def _resize(self, namespace: str, name: str, body: Document) -> tuple[int, Document]:
        """As the API server takes it; what the pod's node makes of it comes later."""
        there = self._of(namespace, "pods").get(name)
        if there is None:
            return _status(404, "NotFound", f'pods "{name}" not found')
        uid, (changed,) = there["metadata"]["uid"], body["spec"]["containers"]
        if body["metadata"].get("uid", uid) != uid:
            return _status(409, "Conflict", "Precondition failed: UID in precondition")
        (container,) = there["spec"]["containers"]
        assert changed["name"] == container["name"]
        before = container["resources"]
        after = {key: {**before[key], **changed["resources"].get(key, {})} for key in ("requests", "limits")}
        if (before["requests"] == before["limits"]) != (after["requests"] == after["limits"]):
            return _status(422, "Invalid", "Pod QOS Class may not change as a result of resizing")
        container["resources"] = after
        told = there["status"].setdefault("conditions", [])
        told[:] = [one for one in told if not one["type"].startswith("PodResize")]
        self._changed(namespace, "pods", there, "MODIFIED")
        self._loop.call_later(self._rng.uniform(0.05, 0.4), lambda: self._actuate(namespace, name, uid))
        return 200, there

    def _actuate(self, namespace: str, name: str, uid: str) -> None:
        """A node gives a container what it is to have, or says why not."""
        pod = self._pod(namespace, name, uid)
        if pod is None or not pod["status"].get("containerStatuses"):
            return
        wanted, (status,) = pod["spec"]["containers"][0]["resources"], pod["status"]["containerStatuses"]
        has = status.get("resources") or wanted
        if self.no_room and _cores_of(wanted) > _cores_of(has):
            why = {"reason": self.no_room, "message": f"node has no room: {wanted['requests']['cpu']} wanted"}
            pod["status"]["conditions"].append({"type": "PodResizePending", "status": "True", **why})
        else:
            status["resources"] = json.loads(json.dumps(wanted))
        self._changed(namespace, "pods", pod, "MODIFIED")

    def _apply(self, namespace: str, kind: str, body: Document) -> tuple[int, Document]:
        there = self._of(namespace, kind).get(body["metadata"]["name"])
        if there is None:
            made = self._create(namespace, kind, body)
            assert made is not None
            return 201, made
        self._changed(namespace, kind, there, "MODIFIED")
        return 200, there

    def _put(self, namespace: str, kind: str, name: str, body: Document) -> tuple[int, Document]:
        there = self._of(namespace, kind).get(name)
        if there is None:
            return _status(404, "NotFound", f'{kind} "{name}" not found')
        if (
            body["metadata"].get("resourceVersion", there["metadata"]["resourceVersion"])
            != there["metadata"]["resourceVersion"]
        ):
            return _status(409, "Conflict", "the object has been modified")
        there["data"] = body["data"]
        self._changed(namespace, kind, there, "MODIFIED")
        return 200, there

    def _all(self, namespace: str, kind: str, query: dict[str, str]) -> tuple[int, Document]:
        if kind == "nodes":
            return 200, {
                "items": [_node(n) for n in range(_NODES)],
                "metadata": {"resourceVersion": str(self._version)},
            }
        wanted = dict(part.split("=", 1) for part in query.get("labelSelector", "").split(",") if part)
        found = [
            one
            for one in self._of(namespace, kind).values()
            if wanted.items() <= one["metadata"].get("labels", {}).items()
        ]
        return 200, {"items": found, "metadata": {"resourceVersion": str(self._version)}}

    # HTTP

    async def _open(self) -> None:
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", 0)
        self.port = self._server.sockets[0].getsockname()[1]

    async def _close(self) -> None:
        self._server.close()
        self._cut_all()
        others = asyncio.all_tasks() - {asyncio.current_task()}
        for task in others:
            task.cancel()
        await asyncio.gather(*others, return_exceptions=True)

    def _cut_all(self) -> None:
        for writer in self._writers:
            writer.transport.abort()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self.regime.dead:
            self.calls.append((time.monotonic(), "connect"))
            writer.transport.abort()
            return
        self._writers.add(writer)
        try:
            while await self._one(reader, writer):
                pass
        except (asyncio.IncompleteReadError, asyncio.CancelledError, ConnectionError):
            pass
        finally:
            self._writers.discard(writer)
            writer.transport.abort()

    async def _one(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> bool:
        """Answer one request; False: the connection is over."""
        head = (await reader.readuntil(b"\r\n\r\n")).decode().split("\r\n")
        method, target, _ = head[0].split(" ")
        headers = {k.lower(): v.strip() for k, _, v in (line.partition(":") for line in head[1:] if line)}
        body = json.loads(await reader.readexactly(int(headers.get("content-length", "0"))) or b"{}")
        url = urlsplit(target)
        query = dict(parse_qsl(url.query))
        path = url.path.strip("/").split("/")
        group = path[1] if path[0] == "apis" else ""
        if path == ["api", "v1"]:
            path.append("apiresources")
        path = path[2:] if path[0] == "api" else path[3:] if path[0] == "apis" else path
        namespace = path[1] if path[0] == "namespaces" else ""
        path = path[2:] if namespace else path
        kind, name, rest = path[0], path[1] if len(path) > 1 else "", path[2:]
        watches = "watch" in query
        self.calls.append(
            (time.monotonic(), " ".join([method, "/".join([kind, *rest]), *(["watch"] if watches else [])]))
        )
        regime, rng = self.regime, self._rng
        if not self.calls[-1][1].startswith(regime.only):
            regime = CALM
        if regime.dead or rng.random() < regime.cut_before:
            return False
        if rng.random() < regime.refuses:
            status, said = _status(regime.status, "Unwell", f"made up: {regime.status}")
            await self._answer(writer, status, said)
            return True
        if (late := rng.random()) < regime.late / 2:
            await asyncio.sleep(rng.uniform(0.2, regime.late_s))
        if watches:
            await self._watch(writer, namespace, kind, query)
            return False
        apply = "apply" in headers.get("content-type", "")
        status, said = self._do(method, namespace, group, kind, name, rest, query, body, apply=apply)
        data = json.dumps(said).encode()
        if regime.late / 2 < late < regime.late:
            await asyncio.sleep(rng.uniform(0.2, regime.late_s))
        if rng.random() < regime.cut_after:
            return False
        await self._answer(writer, status, data)
        return True

    async def _answer(self, writer: asyncio.StreamWriter, status: int, said: Document | bytes) -> None:
        data = said if isinstance(said, bytes) else json.dumps(said).encode()
        more = "Retry-After: 1\r\n" if status == HTTPStatus.TOO_MANY_REQUESTS else ""
        head = f"HTTP/1.1 {status} X\r\nContent-Type: application/json\r\n{more}Content-Length: {len(data)}\r\n\r\n"
        writer.write(head.encode() + data)
        await writer.drain()

    def _do(
        self,
        method: str,
        namespace: str,
        group: str,
        kind: str,
        name: str,
        rest: list[str],
        query: dict[str, str],
        body: Document,
        *,
        apply: bool,
    ) -> tuple[int, Document]:
        if kind == "version":
            return 200, {"major": "1", "minor": str(self.minor)}
        if kind == "apiresources":
            names = ["pods", "pods/log", *(["pods/resize"] if self.minor >= 33 else [])]
            return 200, {"kind": "APIResourceList", "resources": [{"name": one} for one in names]}
        if rest == ["resize"] and kind == "pods" and method == "PATCH" and self.minor >= 33:
            return self._resize(namespace, name, body)
        if rest or group == "metrics.k8s.io":
            return _status(404, "NotFound", "there is no such thing here")
        if method == "GET" and not name:
            return self._all(namespace, kind, query)
        if method == "GET":
            there = self._of(namespace, kind).get(name)
            return _status(404, "NotFound", f'{kind} "{name}" not found') if there is None else (200, there)
        if method == "POST":
            made = self._create(namespace, kind, body)
            return _status(409, "AlreadyExists", f"{kind} already exists") if made is None else (201, made)
        if method == "DELETE":
            return self._delete(namespace, kind, name, body)
        if method == "PUT":
            return self._put(namespace, kind, name, body)
        return self._apply(namespace, kind, body) if apply else self._merge(namespace, kind, name, body)

    async def _watch(self, writer: asyncio.StreamWriter, namespace: str, kind: str, query: dict[str, str]) -> None:
        writer.write(b"HTTP/1.1 200 OK\r\nContent-Type: application/json\r\nTransfer-Encoding: chunked\r\n\r\n")
        version = int(query.get("resourceVersion", "0"))
        told = version
        watcher = _Watcher(namespace, kind)
        if version + 1 < self._oldest:
            watcher.events.put_nowait(("ERROR", 0, b""))
        for at, ns, k, event, line in self._history:
            if at > version and (ns, k) == (namespace, kind):
                watcher.events.put_nowait((event, at, line))
        self._watchers.append(watcher)
        until = time.monotonic() + float(query.get("timeoutSeconds", "60"))
        lost = False
        try:
            while (left := until - time.monotonic()) > 0:
                try:
                    batch = [await asyncio.wait_for(watcher.events.get(), min(left, _BOOKMARK_S))]
                except TimeoutError:
                    if lost:
                        await self._gone(writer)
                        return
                    meta = {"resourceVersion": str(told), "creationTimestamp": None}
                    await _chunk(
                        writer, json.dumps({"type": "BOOKMARK", "object": {"metadata": meta}}).encode() + b"\n"
                    )
                    continue
                while self.regime.mute:
                    await asyncio.sleep(0.1)
                regime, rng = self.regime, self._rng
                if regime.event_late_s:
                    await asyncio.sleep(rng.uniform(0.0, regime.event_late_s))
                while not watcher.events.empty():
                    batch.append(watcher.events.get_nowait())
                if regime.shuffled:
                    rng.shuffle(batch)
                if any(event == "ERROR" for event, _, _ in batch):
                    await self._gone(writer)
                    return
                for _, at, line in batch:
                    if rng.random() < regime.lost:
                        lost = True
                        continue
                    told = max(told, at)
                    for _ in range(2 if rng.random() < regime.twice else 1):
                        await _chunk(writer, line)
            await _chunk(writer, b"")
        finally:
            self._watchers.remove(watcher)

    async def _gone(self, writer: asyncio.StreamWriter) -> None:
        _, said = _status(410, "Expired", "too old resource version")
        await _chunk(writer, json.dumps({"type": "ERROR", "object": said}).encode() + b"\n")
        await _chunk(writer, b"")


async def _chunk(writer: asyncio.StreamWriter, data: bytes) -> None:
    writer.write(b"%x\r\n%s\r\n" % (len(data), data))
    await writer.drain()


def _status(code: int, reason: str, message: str) -> tuple[int, Document]:
    return code, {"kind": "Status", "status": "Failure", "code": code, "reason": reason, "message": message}


def _now() -> str:
    return datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def _container(*, started: bool) -> Document:
    return {"name": "service", "ready": started, "started": started, "state": {"running": {"startedAt": _now()}}}


def _cores_of(resources: Document) -> int:
    """Thousandths that are kept."""
    return int(resources["requests"]["cpu"].removesuffix("m"))


def _node(number: int) -> Document:
    gives = {"cpu": "64", "memory": "256Gi", "pods": "110"}
    status = {"allocatable": gives, "capacity": gives, "nodeInfo": {"architecture": "amd64"}}
    address = {"type": "InternalIP", "address": f"10.0.0.{number + 1}"}
    return {
        "metadata": {"name": f"node-{number}", "resourceVersion": "1"},
        "spec": {},
        "status": {**status, "addresses": [address]},
    }
