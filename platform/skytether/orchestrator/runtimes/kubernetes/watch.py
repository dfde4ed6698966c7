"""What is known of a cluster's pods: a list, then what the API server tells of changes, again and again."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Mapping
from typing import Any

from typing_extensions import override

from ..base import RuntimeFailure
from .cluster import Cluster, RefusedError
from .follow import AGAIN_S, Document, Follower
from .objects import GRACE_S
from .pods import Pods
from .seen import PodState, parse

log = logging.getLogger(__name__)

_LIST_S = 300.0
"""Seconds until all are listed anew: should an event ever have been missed."""
_ILL_S = 1.5
"""A service is first asked of its health up to a second after it has said that it is ready."""
_LINGERS_S = GRACE_S + 1.0
"""After so many seconds nothing of a pod that lingers runs any more."""


class Watch(Follower):
    """Follows pods, in a thread of its own."""

    def __init__(self, cluster: Cluster, selector: str) -> None:
        """``selector``: of the labels that they have."""
        super().__init__(cluster, cluster.path("pods"), "kubernetes-watch", labelSelector=selector)
        self.changed = threading.Event()
        """Set whenever another thing may be known than before; whoever waits for it clears it."""
        self._lock = threading.Lock()
        self._pods = Pods()
        self._gone: dict[str, str] = {}
        """By their uid, names of pods that were forgotten: a late event or list does not bring them back."""
        self._lingers_since: dict[str, float] = {}
        """By uid, since when a pod lingers, by the monotonic clock [s]."""
        self._ill_since: dict[str, float] = {}
        """By uid, since when a pod whose service is up has not been ready yet."""
        self._well: set[str] = set()
        """Uids of pods that were ready."""

    def doubt(self, error: RuntimeFailure) -> None:
        """A call found the API server silent, of which a watch may tell nothing for long: so it is until it answers."""
        self._fail(error)
        self._cut()

    def seen(self, timeout_s: float) -> list[PodState]:
        """All pods of ours; waits for the first list only, ``timeout_s`` [s] at most.

        Raises:
            RuntimeFailure: The API server does not answer, or refuses.
        """
        self._must_know(timeout_s)
        with self._lock:
            return self._pods.all()

    def of(self, instance: str, timeout_s: float) -> list[PodState]:
        """The pods of one instance, the newest run last; raises as ``seen``."""
        self._must_know(timeout_s)
        with self._lock:
            return self._pods.of(instance)

    def _must_know(self, timeout_s: float) -> None:
        self._looked.wait(timeout_s)
        failure = self._failure
        if failure is not None:
            raise type(failure)(*failure.args) if not isinstance(failure, RefusedError) else failure

    def over(self, seen: PodState) -> bool:
        """Whether nothing of it runs any more."""
        if seen.ended or not seen.lingers:
            return seen.ended
        now = time.monotonic()
        return now - self._lingers_since.setdefault(seen.uid, now) > _LINGERS_S

    def ill(self, seen: PodState) -> bool:
        """Whether the health check of a service that is up fails, and not only has not been done yet."""
        if seen.healthy:
            self._well.add(seen.uid)
        if seen.healthy or not seen.started:
            self._ill_since.pop(seen.uid, None)
            return False
        if seen.uid in self._well:
            return True
        now = time.monotonic()
        return now - self._ill_since.setdefault(seen.uid, now) > _ILL_S

    def catch_up(self) -> None:
        """List all of them now.

        Raises:
            RuntimeFailure: The API server does not answer, or refuses.
        """
        self._list()

    def forget(self, seen: PodState) -> None:
        """It was removed: no event that is late brings it back."""
        with self._lock:
            there = self._pods.get(seen.name)
            if there is not None and there.uid == seen.uid:
                self._pods.drop(seen.name)
            self._gone[seen.uid] = seen.name
        self.changed.set()

    def update(self, document: Mapping[str, Any], *, gone: bool = False) -> None:
        """A pod as an answer, or an event, describes it."""
        seen = parse(document)
        if seen is None:
            return
        if gone:
            self.forget(seen)
            return
        with self._lock:
            before = self._pods.get(seen.name)
            if seen.uid not in self._gone and (before is None or _is_newer(seen, before)):
                self._pods.put(seen)
        self.changed.set()

    def _run(self) -> None:
        while not self._closing.is_set():
            try:
                version = self._list()
                until = time.monotonic() + _LIST_S
                while version and self._failure is None and not self._closing.is_set() and time.monotonic() < until:
                    version = self._follow(version)
            except RuntimeFailure as error:
                self._fail(error)
            except Exception as error:
                log.exception("following a cluster failed")
                self._fail(RuntimeFailure(f"the API server's answer is not understood: {error}"))
            if self._failure is not None:
                self._closing.wait(AGAIN_S)

    def _fail(self, error: RuntimeFailure) -> None:
        if self._closing.is_set():
            return
        if str(error) != str(self._failure):
            log.warning("%s", error)
        self._failure = error
        self._looked.set()

    def _list(self) -> str:
        """The version of the list."""
        found: dict[str, PodState] = {}

        def add(document: Document) -> None:
            seen = parse(document)
            if seen is not None:
                found[seen.name] = seen

        version = self._read(add)
        with self._lock:
            # What an answer has told meanwhile may be newer than the list.
            for name, seen in found.items():
                before = self._pods.get(name)
                if before is not None and before.uid == seen.uid and not _is_newer(seen, before):
                    found[name] = before
            at = _number(version)
            newer = [s for s in self._pods.all() if s.name not in found and _number(s.version) > at]
            self._pods = Pods([*(s for s in found.values() if s.uid not in self._gone), *newer])
            self._gone = {uid: name for uid, name in self._gone.items() if name in found}
            there = {seen.uid for seen in self._pods.all()}
            self._lingers_since = {uid: at for uid, at in self._lingers_since.items() if uid in there}
            self._ill_since = {uid: at for uid, at in self._ill_since.items() if uid in there}
            self._well &= there
        self._failure = None
        self._looked.set()
        self.changed.set()
        return version

    @override
    def _on_event(self, document: Document, *, gone: bool) -> None:
        self.update(document, gone=gone)


def _is_newer(seen: PodState, before: PodState) -> bool:
    return seen.uid != before.uid or _number(seen.version) >= _number(before.version)


def _number(version: str) -> int:
    """Versions are numbers that grow, at every API server that there is (and by contract since Kubernetes 1.35)."""
    return int(version) if version.isdecimal() else 0
