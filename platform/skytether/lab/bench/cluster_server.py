"""An API server of Kubernetes that is made up, with nodes that are made up: as large as no machine's real one.

It answers what a site of runtime ``kubernetes`` asks for, with labels, pages, versions and watches as the real one has
them. A pod whose Secret is there runs a moment later. All calls are counted; more than are allowed in a second get 429
with ``Retry-After``, as of the real one's priority and fairness.
"""

from __future__ import annotations

import argparse
import asyncio
import heapq
import itertools
import json
import random
import socket
import sys
import time
import uuid
from collections import Counter, deque
from collections.abc import AsyncIterator, Callable, Mapping
from datetime import UTC, datetime
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse, Response, StreamingResponse
from starlette.routing import Route

_NODES = 200
_CORES, _MEMORY_GIB = 64, 256
"""Of each node."""
_SEED = 16
_TICK_S = 0.02
_BOOKMARK_S = 5.0
_END_S = 0.5
"""From when a pod is told to end until it has."""
Document = dict[str, Any]


class MadeUpCluster:
    """Objects of one cluster, in memory. All in one loop."""

    def __init__(self, start_s: float, most_per_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        """``start_s``: from a pod's Secret to its readiness, give or take a fifth; ``most_per_s``: calls answered."""
        self._start_s, self._most_per_s, self._clock = start_s, most_per_s, clock
        self._rng = random.Random(_SEED)
        self._objects: dict[str, dict[str, Document]] = {}
        """By kind and name."""
        self._version = 0
        self._watchers: list[tuple[Mapping[str, str], asyncio.Queue[bytes | None]]] = []
        """Of pods, each with the labels that it follows."""
        self._ports: set[tuple[str, int]] = set()
        self._turns = itertools.cycle(range(_NODES))
        self._due: list[tuple[float, int, str, str]] = []
        """When, a number, uid and name of pods that change."""
        self._numbers = itertools.count()
        self._calls: deque[float] = deque()
        """Times of the last second's."""
        self.kinds: Counter[str] = Counter()
        self.most_in_a_second = 0
        self.refused = 0

    def admits(self, kind: str) -> bool:
        """Count a call; False: there were too many in the last second."""
        now = self._clock()
        while self._calls and self._calls[0] <= now - 1.0:
            self._calls.popleft()
        if len(self._calls) >= self._most_per_s:
            self.refused += 1
            return False
        self._calls.append(now)
        self.kinds[kind] += 1
        self.most_in_a_second = max(self.most_in_a_second, len(self._calls))
        return True

    def of(self, kind: str) -> dict[str, Document]:
        return self._objects.setdefault(kind, {})

    @property
    def version(self) -> str:
        return str(self._version)

    def _changed(self, kind: str, document: Document, event: str) -> None:
        self._version += 1
        document["metadata"]["resourceVersion"] = str(self._version)
        if kind == "pods":
            line = json.dumps({"type": event, "object": document}).encode() + b"\n"
            for labels, watcher in self._watchers:
                if _has(document, labels):
                    watcher.put_nowait(line)

    def create(self, kind: str, document: Document) -> Document | None:
        """None: its name is taken."""
        meta, there = document["metadata"], self.of(kind)
        if meta["name"] in there:
            return None
        meta |= {"uid": str(uuid.UUID(int=self._rng.getrandbits(128))), "creationTimestamp": _now()}
        if kind == "pods":
            document["spec"]["nodeName"] = self._node(document)
            document["status"] = {"phase": "Pending", "hostIP": "10.0.0.1"}
        there[meta["name"]] = document
        self._changed(kind, document, "ADDED")
        if kind == "secrets" and (pod := self.of("pods").get(meta["name"])):
            self._after(self._start_s * self._rng.uniform(0.8, 1.2), pod)
        return document

    def _node(self, pod: Document) -> str:
        ports = [port["hostPort"] for port in pod["spec"]["containers"][0]["ports"] if "hostPort" in port]
        for _ in range(_NODES):
            node = f"node-{next(self._turns)}"
            if not any((node, port) in self._ports for port in ports):
                break
        self._ports |= {(node, port) for port in ports}
        return node

    def _after(self, seconds: float, pod: Document) -> None:
        meta = pod["metadata"]
        heapq.heappush(self._due, (self._clock() + seconds, next(self._numbers), meta["uid"], meta["name"]))

    def end(self, pod: Document) -> None:
        """Have it end in a moment, as its deadline says."""
        pod["spec"]["activeDeadlineSeconds"] = 1
        self._changed("pods", pod, "MODIFIED")
        self._after(_END_S, pod)

    def delete(self, kind: str, name: str) -> bool:
        document = self.of(kind).pop(name, None)
        if document is None:
            return False
        if kind == "pods":
            self.of("secrets").pop(name, None)
            for port in document["spec"]["containers"][0]["ports"]:
                self._ports.discard((document["spec"]["nodeName"], port.get("hostPort", 0)))
        self._changed(kind, document, "DELETED")
        return True

    async def play(self) -> None:
        """The nodes: what is due happens."""
        while True:
            await asyncio.sleep(_TICK_S)
            while self._due and self._due[0][0] <= self._clock():
                _, _, uid, name = heapq.heappop(self._due)
                pod = self.of("pods").get(name)
                if pod is not None and pod["metadata"]["uid"] == uid:
                    pod["status"] = _ended() if pod["spec"].get("activeDeadlineSeconds") else _running()
                    self._changed("pods", pod, "MODIFIED")

    async def follow(self, kind: str, labels: Mapping[str, str], until: float) -> AsyncIterator[bytes]:
        """What changes from now on, line by line, with a bookmark now and then; of anything but pods nothing does."""
        queue: asyncio.Queue[bytes | None] = asyncio.Queue()
        watchers = self._watchers if kind == "pods" else []
        watchers.append((labels, queue))
        try:
            while (left := until - self._clock()) > 0:
                try:
                    line = await asyncio.wait_for(queue.get(), min(left, _BOOKMARK_S))
                except TimeoutError:
                    meta = {"resourceVersion": self.version, "creationTimestamp": None}
                    yield json.dumps({"type": "BOOKMARK", "object": {"metadata": meta}}).encode() + b"\n"
                    continue
                if line is None:
                    return
                yield line
        finally:
            watchers.remove((labels, queue))


def _has(document: Document, labels: Mapping[str, str]) -> bool:
    return all(document["metadata"]["labels"].get(key) == value for key, value in labels.items())


def _now() -> str:
    return datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def _running() -> Document:
    told = {"name": "service", "ready": True, "started": True, "state": {"running": {"startedAt": _now()}}}
    return {"phase": "Running", "hostIP": "10.0.0.1", "podIP": "10.1.0.1", "containerStatuses": [told]}


def _ended() -> Document:
    over = {"exitCode": 143, "finishedAt": _now(), "reason": "Error"}
    told = {"name": "service", "ready": False, "started": False, "state": {"terminated": over}}
    return {"phase": "Failed", "reason": "DeadlineExceeded", "hostIP": "10.0.0.1", "containerStatuses": [told]}


def _node(number: int) -> Document:
    gives = {"cpu": str(_CORES), "memory": f"{_MEMORY_GIB}Gi", "pods": "110"}
    status = {"allocatable": gives, "capacity": gives, "nodeInfo": {"architecture": "amd64"}}
    address = {"type": "InternalIP", "address": f"10.0.{number // 250}.{number % 250 + 1}"}
    return {"metadata": {"name": f"node-{number}"}, "spec": {}, "status": {**status, "addresses": [address]}}


def _said(status: int, reason: str, message: str, headers: dict[str, str] | None = None) -> Response:
    document = {"kind": "Status", "status": "Failure", "code": status, "reason": reason, "message": message}
    return JSONResponse(document, status, headers)


class Answers:
    """HTTP over a cluster."""

    def __init__(self, cluster: MadeUpCluster) -> None:
        self._cluster = cluster

    async def calls(self, _: Request) -> Response:
        """What was asked so far, for who measures; begins the largest second anew."""
        cluster = self._cluster
        told = {"calls": dict(cluster.kinds), "most_in_a_second": cluster.most_in_a_second, "refused": cluster.refused}
        cluster.most_in_a_second = 0
        return JSONResponse(told)

    async def any(self, request: Request) -> Response:
        """Nodes, and objects of a namespace by kind and name."""
        path = request.url.path.strip("/").split("/")
        if path == ["version"]:
            return JSONResponse({"major": "1", "minor": "33"})
        if path == ["api", "v1"]:
            return JSONResponse({"kind": "APIResourceList", "groupVersion": "v1", "resources": [{"name": "pods"}]})
        path = path[2:] if path[0] == "api" else path[3:]
        if path[:1] == ["namespaces"]:
            path = path[2:]
        kind, name, rest = path[0], path[1] if len(path) > 1 else "", path[2:]
        if not self._cluster.admits(f"{request.method} {'/'.join([kind, *rest])}"):
            return _said(429, "TooManyRequests", "too many requests, try again later", {"Retry-After": "1"})
        if rest or not kind:
            return _said(404, "NotFound", "there is no such thing here")
        if request.method == "GET":
            return self._one(kind, name) if name else self._all(kind, request)
        document: Document = json.loads(await request.body() or b"{}")
        if request.method == "POST":
            made = self._cluster.create(kind, document)
            return (
                _said(409, "AlreadyExists", f'{kind} "{name}" already exists') if made is None else JSONResponse(made)
            )
        if request.method == "PATCH" and "apply" in request.headers.get("Content-Type", ""):
            self._cluster.delete(kind, name)
            return JSONResponse(self._cluster.create(kind, document))
        there = self._cluster.of(kind).get(name)
        if there is None:
            return _said(404, "NotFound", f'{kind} "{name}" not found')
        if request.method == "DELETE":
            self._cluster.delete(kind, name)
            return JSONResponse({"kind": "Status", "status": "Success"})
        if request.method == "PATCH" and kind == "pods":
            self._cluster.end(there)
            return JSONResponse(there)
        return self._put(kind, there, document)

    def _put(self, kind: str, there: Document, document: Document) -> Response:
        seen = document["metadata"].get("resourceVersion", there["metadata"]["resourceVersion"])
        if seen != there["metadata"]["resourceVersion"]:
            return _said(409, "Conflict", "the object has been modified")
        self._cluster.delete(kind, there["metadata"]["name"])
        return JSONResponse(self._cluster.create(kind, document))

    def _one(self, kind: str, name: str) -> Response:
        found = self._cluster.of(kind).get(name)
        return _said(404, "NotFound", f'{kind} "{name}" not found') if found is None else JSONResponse(found)

    def _all(self, kind: str, request: Request) -> Response:
        asked = request.query_params
        wanted = dict(part.split("=", 1) for part in asked.get("labelSelector", "").split(",") if part)
        if asked.get("watch"):
            until = time.monotonic() + float(asked.get("timeoutSeconds", "300"))
            return StreamingResponse(self._cluster.follow(kind, wanted, until), media_type="application/json")
        if kind == "nodes":
            return JSONResponse({"items": [_node(n) for n in range(_NODES)], "metadata": {"resourceVersion": "1"}})
        found = [one for one in self._cluster.of(kind).values() if _has(one, wanted)]
        first, most = int(asked.get("continue", "0")), int(asked.get("limit", "0")) or len(found)
        more = str(first + most) if first + most < len(found) else ""
        meta = {"resourceVersion": self._cluster.version, "continue": more}
        return JSONResponse({"items": found[first : first + most], "metadata": meta})


def app_of(cluster: MadeUpCluster) -> Starlette:
    """The application."""
    answers = Answers(cluster)
    methods = ["GET", "POST", "PUT", "PATCH", "DELETE"]
    return Starlette(routes=[Route("/calls", answers.calls), Route("/{path:path}", answers.any, methods=methods)])


async def _serve(cluster: MadeUpCluster, listener: socket.socket) -> None:
    playing = asyncio.create_task(cluster.play())
    await uvicorn.Server(uvicorn.Config(app_of(cluster), log_level="warning", access_log=False)).serve([listener])
    playing.cancel()


def main() -> None:
    """Serve on loopback; the first line of output is the port."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--start-s", type=float, default=1.0)
    parser.add_argument("--most-per-s", type=float, default=float("inf"))
    asked = parser.parse_args()
    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # asyncio does it for sockets of its own only
        sys.stdout.write(f"{listener.getsockname()[1]}\n")
        sys.stdout.flush()
        asyncio.run(_serve(MadeUpCluster(asked.start_s, asked.most_per_s), listener))


if __name__ == "__main__":
    main()
