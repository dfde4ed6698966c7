"""How much services have written into their data volumes: asked of the engine, in a thread, for it takes its time."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

import requests
from docker.errors import create_api_error_from_http_exception

from ..base import RuntimeFailure
from .engine import Engine

log = logging.getLogger(__name__)

_EVERY_S = 30.0
_PATIENCE_S = 120.0
"""The engine looks at every file of its volumes."""
_TOLERATED = 3
"""Weighings in a row that may come to nothing before it is told: one that somebody else has asked for is refused."""


def sizes(answer: Mapping[str, Any]) -> dict[str, int]:
    """Bytes by volume, out of what the engine says of its disk; those of which it does not know are left out."""
    found = {}
    # The second is where engines from version 1.52 of their interface on say it.
    for volume in answer.get("Volumes") or (answer.get("VolumeUsage") or {}).get("Items") or ():
        size = (volume.get("UsageData") or {}).get("Size", -1)
        if size >= 0:
            found[str(volume["Name"])] = int(size)
    return found


class Scales:
    """Knows which data volumes hold more than they may. Safe from any thread."""

    def __init__(self, engine: Engine, data_mb: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._engine = engine
        self._data_mb = data_mb
        self._clock = clock
        self._weighed_at = -_EVERY_S
        self._thread: threading.Thread | None = None
        self._full: frozenset[str] = frozenset()
        self._failures = 0
        """In a row."""

    def exceeds(self, volume: str) -> str:
        """Why nobody may write to it any more; empty: they may."""
        if volume not in self._full:
            return ""
        return (
            f"has more than {self._data_mb} MiB in the volume {volume} (the site's data_mb): delete what is not needed"
        )

    def begin(self) -> None:
        """Weigh them, unless that is under way or was done a moment ago. Does not wait."""
        if self._clock() - self._weighed_at < _EVERY_S or (self._thread is not None and self._thread.is_alive()):
            return
        self._weighed_at = self._clock()
        self._thread = threading.Thread(target=self._weigh_quietly, name="docker-volumes", daemon=True)
        self._thread.start()

    def _weigh_quietly(self) -> None:
        try:
            self.weigh()
        except RuntimeFailure as error:
            self._failures += 1
            level = logging.WARNING if self._failures == _TOLERATED else logging.DEBUG
            log.log(level, "volumes are not weighed, so that data_mb (%d) bounds nothing: %s", self._data_mb, error)
            return
        if self._failures >= _TOLERATED:
            log.info("volumes are weighed again")
        self._failures = 0

    def weigh(self) -> None:
        """Ask the engine, and wait for it.

        Raises:
            RuntimeFailure: It does not say.
        """
        with self._engine.asked():
            api = self._engine.api(_PATIENCE_S)
            # The SDK only knows how to have everything weighed, each layer of each image too.
            asked = {"type": "volume", "verbose": "1"}
            said = api.get(f"{api.base_url}/v{api.api_version}/system/df", params=asked, timeout=api.timeout)
            try:
                said.raise_for_status()
            except requests.HTTPError as error:
                create_api_error_from_http_exception(error)
            answer = said.json()
        most = self._data_mb << 20
        self._full = frozenset(name for name, size in sizes(answer).items() if size > most)
