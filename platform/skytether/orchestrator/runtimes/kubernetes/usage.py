"""What pods use: by the cluster's metrics API where it has one, otherwise by what each service says of its container.

The API is asked once for all pods. What services say comes with their reports, which are read anyway; it is bounded by
what their containers may have. The kubelet is not asked: the right to (``nodes/proxy``) is that to run commands in
every container of the node.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from http import HTTPStatus
from typing import Any

from skytether.api.usage import NO_USAGE, Usage

from ..base import RuntimeFailure
from ..now_and_then import NowAndThen
from .cluster import Cluster, RefusedError
from .objects import OWNER
from .resize import quantity
from .seen import PodState

log = logging.getLogger(__name__)

_GROUP = "metrics.k8s.io/v1beta1"
_EVERY_S = 15.0
"""Seconds between two looks: metrics-server itself looks as often."""
_AGAIN_S = 300.0
"""The same where the cluster has no such API, or the account no right to it."""
_SLACK_S = 60.0
"""Seconds by which the API server's clock may differ from ours."""


@dataclass(frozen=True, slots=True)
class Sample:
    """What the metrics API says of a pod."""

    at: float
    """When its window ended [s since the epoch]."""
    window_s: float
    cores: float
    """Mean over the window."""
    memory_bytes: int


def pull_samples(document: Mapping[str, Any]) -> dict[str, Sample]:
    """By pod, out of a ``PodMetricsList``."""
    found = {}
    for item in document.get("items") or ():
        used = [container["usage"] for container in item.get("containers") or ()]
        if used:
            found[item["metadata"]["name"]] = Sample(
                at=datetime.fromisoformat(item["timestamp"]).timestamp(),
                window_s=_seconds(item.get("window", "0s")),
                cores=sum(quantity(one["cpu"]) for one in used),
                memory_bytes=int(sum(quantity(one["memory"]) for one in used)),
            )
    return found


def _seconds(text: str) -> float:
    """Of a duration as Go writes it: ``1m2.5s``."""
    minutes, _, seconds = text.rpartition("m") if not text.endswith("ms") else ("", "", "0s")
    return 60 * float(minutes or 0) + float(seconds.removesuffix("s") or 0)


def bounded(told: Usage, seen: PodState, now: float) -> Usage:
    """What a service says, as far as its container can have used it; ``now``: seconds since the epoch."""
    cpu_s, memory = told.cpu_s, told.memory_bytes
    if cpu_s is not None and seen.cpu_limit:
        cpu_s = min(cpu_s, quantity(seen.cpu_limit) * max(0.0, now - seen.made_at + _SLACK_S))
    if memory is not None and seen.memory_limit:
        memory = min(memory, int(quantity(seen.memory_limit)))
    return replace(told, cpu_s=cpu_s, memory_bytes=memory)


class Meter:
    """Knows what a site's pods use. Safe from any thread."""

    def __init__(
        self,
        cluster: Cluster,
        owner: str,
        told: Callable[[str], Usage],
        clock: Callable[[], float] = time.monotonic,
        wall: Callable[[], float] = time.time,
    ) -> None:
        """``told``: what the service of a pod says; ``wall``: seconds since the epoch."""
        self._path = cluster.path("pods", group=_GROUP)
        self._query = {"labelSelector": f"{OWNER}={owner}"}
        self._cluster = cluster
        self._told = told
        self._clock = clock
        self._wall = wall
        self._not_before = 0.0
        self._now_and_then = NowAndThen("kubernetes-metrics", _EVERY_S, clock, self._refresh)
        self._known: Mapping[str, tuple[Sample, float]] = {}
        """By pod: the newest sample, and processor seconds until then."""
        self._last: dict[str, Usage] = {}
        """By uid, what was last known while it ran."""

    def of(self, seen: PodState) -> Usage:
        """What a run has used, as far as is known; what has ended, until then."""
        if not seen.running:
            return self._last.get(seen.uid, NO_USAGE)
        usage = bounded(self._told(seen.name), seen, self._wall())
        known = self._known.get(seen.name)
        if known is not None:
            usage = replace(usage, cpu_s=known[1], memory_bytes=known[0].memory_bytes)
        if usage != NO_USAGE:
            self._last[seen.uid] = usage
        return usage

    def begin(self, there: Iterable[PodState]) -> None:
        """Look, unless that is under way or was done a moment ago, and forget all but these. Does not wait."""
        uids = {seen.uid for seen in there}
        self._last = {uid: usage for uid, usage in self._last.items() if uid in uids}
        if self._clock() >= self._not_before:
            self._now_and_then.begin()

    def _refresh(self) -> None:
        try:
            samples = pull_samples(self._cluster.get(self._path, **self._query))
        except RefusedError as error:
            self._not_before = self._clock() + _AGAIN_S
            if error.status != HTTPStatus.NOT_FOUND:  # or the cluster has no such API
                log.info("the metrics API is not read: %s", error)
            self._known = {}
            return
        except (RuntimeFailure, ValueError, KeyError, TypeError) as error:
            log.debug("the metrics API is not read: %s", error)
            return
        self._known = {pod: self._added(pod, sample) for pod, sample in samples.items()}

    def _added(self, pod: str, sample: Sample) -> tuple[Sample, float]:
        """With its processor seconds: what was used before the first sample only the service itself can tell."""
        before = self._known.get(pod)
        if before is None:
            return sample, max(self._told(pod).cpu_s or 0.0, sample.cores * sample.window_s)
        return sample, before[1] + sample.cores * max(0.0, sample.at - before[0].at)
