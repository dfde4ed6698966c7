"""What services in pods report, and what they say of their containers' use.

Their pods are asked for it by way of the API server, now and then and in a thread.
"""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable, Iterable

from skytether.api.service_report import MOST_BYTES, ServiceReport, pull_reports, pull_step_s
from skytether.api.usage import NO_USAGE, Usage, pull_usage

from ..base import RuntimeFailure
from ..now_and_then import NowAndThen
from .cluster import Cluster
from .objects import HEALTH_PORT
from .pace import Pace

log = logging.getLogger(__name__)

_EVERY_S = 3.0
"""Seconds between two looks at all of them."""
TIMEOUT_S = 2.0
"""Of one pod's answer."""
_REST = 20
"""A pod is left alone for so many times as long as its answer took: it has a twentieth of the time that all share."""
_PER_S = 100.0
"""Pods that are asked in a second, at most: of ten thousand each has its turn every two minutes."""

_Told = tuple[tuple[ServiceReport, ...], Usage, float | None]
_NOTHING: _Told = (), NO_USAGE, None


class ReportReader:
    """Knows the newest reports of a site's pods. Safe from any thread."""

    def __init__(
        self, cluster: Cluster, running: Callable[[], Iterable[str]], clock: Callable[[], float] = time.monotonic
    ) -> None:
        """``running`` tells the pods to look at; it may raise what the cluster's failure is."""
        self._cluster = cluster
        self._running = running
        self._now_and_then = NowAndThen("kubernetes-reports", _EVERY_S, clock, self._refresh)
        self._closing = False
        self._rest_until: dict[str, float] = {}
        """By pod, by the monotonic clock [s]."""
        self._pace = Pace(_PER_S, 1)
        self._known: dict[str, _Told] = {}

    def of(self, pod: str) -> tuple[ServiceReport, ...]:
        """What it reported, as read last."""
        return self._known.get(pod, _NOTHING)[0]

    def usage(self, pod: str) -> Usage:
        """What it says that it uses, as read last."""
        return self._known.get(pod, _NOTHING)[1]

    def step_s(self, pod: str) -> float | None:
        """How long it says that its steps take, as read last."""
        return self._known.get(pod, _NOTHING)[2]

    def begin(self) -> None:
        """Look at them, unless that is under way or was done a moment ago. Does not wait."""
        self._now_and_then.begin()

    def close(self) -> None:
        self._closing = True

    def _refresh(self) -> None:
        rest_until: dict[str, float] = {}
        try:
            for pod in self._running():
                if self._closing:
                    return
                rest = self._rest_until.get(pod, 0.0)
                if rest <= time.monotonic():
                    self._pace.wait()
                    before = time.monotonic()
                    self._known[pod] = self._ask(pod)
                    after = time.monotonic()
                    rest = after + _REST * (after - before)
                rest_until[pod] = rest
        except RuntimeFailure as error:
            log.debug("reports of services are not read: %s", error)
            return
        self._rest_until = rest_until
        self._known = {pod: told for pod, told in self._known.items() if pod in rest_until}

    def _ask(self, pod: str) -> _Told:
        path = self._cluster.path("pods", f"{pod}:{HEALTH_PORT}/proxy/reports")
        try:
            document = json.loads(self._cluster.small(path, MOST_BYTES, TIMEOUT_S))
            return pull_reports(document), pull_usage(document), pull_step_s(document)
        except (ValueError, RecursionError):
            return _NOTHING
        except RuntimeFailure as error:  # this one alone: it has just ended, or speaks no HTTP
            log.debug("reports of pod %s are not read: %s", pod, error)
            return self._known.get(pod, _NOTHING)
