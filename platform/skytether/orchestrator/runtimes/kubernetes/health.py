"""What a service says itself whose health check has failed, by its node's word.

On a busy machine a check ends too late, and then the next: a service that is well would be begun anew. So it is asked
once more, by way of the API server.
"""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Callable

from skytether.api.service_report import MOST_BYTES, pull_trouble

from ..base import RuntimeFailure
from ..now_and_then import NowAndThen
from .cluster import Cluster, RefusedError
from .objects import HEALTH_PORT
from .pace import Pace
from .seen import PodState

log = logging.getLogger(__name__)

FAILS = "its health check fails"
EVERY_S = 0.5
"""Seconds between two looks at all that are doubted."""
TIMEOUT_S = 1.0
"""Of one answer."""
_TIMES = 3
"""Who answers nothing so often in a row is not well."""
_PER_S = 50.0
"""Services that are asked in a second, at most."""


class Health:
    """Knows what is wrong with services that are doubted. Safe from any thread."""

    def __init__(
        self, cluster: Cluster, told: Callable[[], object], clock: Callable[[], float] = time.monotonic
    ) -> None:
        """``told`` is called when something else is known than before."""
        self._cluster = cluster
        self._told = told
        self._now_and_then = NowAndThen("kubernetes-health", EVERY_S, clock, self._check)
        self._pace = Pace(_PER_S, 1)
        self._lock = threading.Lock()
        self._doubted: dict[str, PodState] = {}
        self._troubles: dict[str, str] = {}
        """By uid of a pod that is doubted; empty: it is well."""
        self._closing = False

    def trouble(self, seen: PodState, doubted: bool) -> str:
        """What is wrong with a service; empty: nothing that is known. Does not wait.

        Args:
            seen: Its pod.
            doubted: Its node says that its health check fails.
        """
        with self._lock:
            if not doubted:
                self._doubted.pop(seen.uid, None)
                self._troubles.pop(seen.uid, None)
                return ""
            self._doubted[seen.uid] = seen
            trouble = self._troubles.get(seen.uid, "")
        if not trouble:
            self._now_and_then.begin()
        return trouble

    def keep(self, uids: set[str]) -> None:
        """Forget all pods but these."""
        with self._lock:
            self._doubted = {uid: seen for uid, seen in self._doubted.items() if uid in uids}
            self._troubles = {uid: trouble for uid, trouble in self._troubles.items() if uid in uids}

    def close(self) -> None:
        self._closing = True

    def _check(self) -> None:
        with self._lock:
            doubted = [seen for uid, seen in self._doubted.items() if not self._troubles.get(uid)]
        try:
            for seen in doubted:
                if self._closing:
                    return
                trouble = self._ask(seen.name)
                with self._lock:
                    if seen.uid in self._doubted:
                        self._troubles[seen.uid] = trouble
                if trouble:
                    self._told()
        except RuntimeFailure as error:  # nothing is known of any
            log.debug("the health of services is not known: %s", error)

    def _ask(self, pod: str) -> str:
        """Raises RuntimeFailure: the API server does not answer either."""
        path = self._cluster.path("pods", f"{pod}:{HEALTH_PORT}/proxy/reports")
        for _ in range(_TIMES):
            self._pace.wait()
            try:
                return pull_trouble(json.loads(self._cluster.small(path, MOST_BYTES, TIMEOUT_S)), FAILS)
            except (ValueError, RecursionError, RefusedError):
                return FAILS
            except RuntimeFailure as error:
                log.debug("pod %s does not say how it is: %s", pod, error)
        self._cluster.get("/version")
        return FAILS
