"""Following a kind of objects of a cluster: a list, then what the API server tells of changes."""

from __future__ import annotations

import json
import logging
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from http import HTTPStatus
from typing import Any

import urllib3

from ..base import RuntimeFailure
from .cluster import Cluster, ClusterGoneError, cut

log = logging.getLogger(__name__)

AGAIN_S = 1.0
"""Between two attempts to reach an API server that does not answer."""
_WATCH_S = 60
"""The API server ends a watch after this, so that one that is dead is noticed."""
_SILENCE_S = _WATCH_S + 15.0
_PAGE = 500
"""Objects of one answer."""
_MOST_EVENT = 4 << 20
"""Bytes."""
Document = Mapping[str, Any]


class Follower(ABC):
    """A thread that follows, and what it knows of whether the API server answers."""

    def __init__(self, cluster: Cluster, path: str, name: str, **query: str) -> None:
        """``name``: of the thread; ``query``: which of the objects at ``path``."""
        self._cluster = cluster
        self._path, self._query = path, query
        self._failure: RuntimeFailure | None = ClusterGoneError("the API server has not answered yet")
        self._looked = threading.Event()
        self._closing = threading.Event()
        self._answer: urllib3.HTTPResponse | None = None
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        self._closing.set()
        self._cut()
        self._thread.join(5.0)

    def _cut(self) -> None:
        """End the watch that is under way."""
        answer = self._answer
        if answer is not None:
            cut(answer)

    @abstractmethod
    def _run(self) -> None:
        """List and follow until it is closed."""

    @abstractmethod
    def _on_event(self, document: Document, *, gone: bool) -> None:
        """One of them has changed."""

    def _read(self, add: Callable[[Document], None]) -> str:
        """Read all of them, page by page; the version of the list."""
        query: dict[str, str | int] = {**self._query, "limit": _PAGE}
        while True:
            said = self._cluster.get(self._path, **query)
            for document in said["items"]:
                add(document)
            meta = said["metadata"]
            if not meta.get("continue"):
                return str(meta["resourceVersion"])
            query["continue"] = meta["continue"]

    def _follow(self, version: str) -> str:
        """Take what changes from one version on; the version it came to, empty: the list is to be read anew."""
        began = time.monotonic()
        version = self._watch(version)
        self._closing.wait(began + AGAIN_S - time.monotonic())  # a watch that ends at once is no watch
        return version

    def _watch(self, version: str) -> str:
        query: dict[str, str | int] = {
            **self._query,
            "watch": "true",
            "allowWatchBookmarks": "true",
            "resourceVersion": version,
            "timeoutSeconds": _WATCH_S,
        }
        with self._cluster.stream(self._path, _SILENCE_S, **query) as answer:
            self._answer = answer
            try:
                if self._closing.is_set():
                    return ""  # `close` found nothing to cut yet
                for event in _events(answer):
                    if self._closing.is_set():
                        return ""
                    kind, document = event.get("type"), event.get("object") or {}
                    if kind == "ERROR":
                        if document.get("code") != HTTPStatus.GONE:
                            log.info("a watch has ended: %s", document.get("message"))
                        return ""
                    version = str(document.get("metadata", {}).get("resourceVersion", version))
                    if kind in ("ADDED", "MODIFIED", "DELETED"):
                        self._on_event(document, gone=kind == "DELETED")
            finally:
                self._answer = None
        return version


def _events(answer: urllib3.HTTPResponse) -> Iterator[Any]:
    """The lines of a watch, as documents."""
    rest = b""
    for piece in answer.stream(1 << 16):
        *lines, rest = (rest + piece).split(b"\n")
        if len(rest) > _MOST_EVENT:
            raise RuntimeFailure(f"the API server tells of an object of more than {_MOST_EVENT >> 20} MiB")
        for line in lines:
            if line.strip():
                yield json.loads(line)
