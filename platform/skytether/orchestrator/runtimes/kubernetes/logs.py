"""The log of a running pod, as the API server sends it."""

from __future__ import annotations

from collections.abc import Iterator

import urllib3

from ..pumped_log import SILENCE_S, PumpedLog
from .cluster import Cluster, cut


class PodLog(PumpedLog):
    """Follows one run of a pod."""

    def __init__(self, cluster: Cluster, pod: str, lines: int) -> None:
        self._cluster = cluster
        self._path = cluster.path("pods", f"{pod}/log")
        self._lines = lines
        self._answer: urllib3.HTTPResponse | None = None
        super().__init__("kubernetes-log")

    def _arriving(self) -> Iterator[bytes]:
        with self._cluster.stream(self._path, SILENCE_S, follow="true", tailLines=self._lines) as answer:
            self._answer = answer
            while not self._closed.is_set() and (piece := answer.read1(1 << 16)):
                yield piece
        self._answer = None

    def _let_go(self) -> None:
        if self._answer is not None:
            cut(self._answer)
