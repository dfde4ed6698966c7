"""How much services have written into their volumes: asked of the engine, in a thread, for it takes its time."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import requests
from docker.errors import create_api_error_from_http_exception

from ..base import RuntimeFailure
from ..now_and_then import NowAndThen
from .client import document
from .engine import Engine
from .fence import remove_volume
from .objects import BESIDE, INSTANCE, OWNER, stored_by_robot

log = logging.getLogger(__name__)

_EVERY_S = 30.0
_OWN_MB = 64
"""MiB in each other volume: of the grant, where a service writes its ready file, and those that an image declares. As
much as in the own folder of a process."""
_MOST = 1 << 50
"""Bytes of a volume that are believed: beyond any disk, and sums of them are numbers still."""
_PATIENCE_S = 120.0
"""The engine looks at every file of its volumes."""
_UNKNOWN = 2
"""Weighings in a row at which the engine could not look at all of a volume: at one, a folder may just have gone."""
_TOLERATED = 3
"""Weighings in a row that may come to nothing before it is told: one that somebody else has asked for is refused."""


def sizes(answer: Mapping[str, Any]) -> dict[str, int]:
    """Bytes by volume, out of what the engine says of its disk; negative: it could not look at all that is in there."""
    found = {}
    # The second is where engines from version 1.52 of their interface on say it.
    for volume in answer.get("Volumes") or (answer.get("VolumeUsage") or {}).get("Items") or ():
        size = (volume.get("UsageData") or {}).get("Size")
        if isinstance(size, int):
            found[str(volume["Name"])] = min(size, _MOST)
    return found


def remove_left(engine: Engine, owner: str, *, data: bool = False) -> None:
    """Remove the volumes of containers that were removed without them: one of each holds a session's key.

    With ``data`` also those that outlive their containers. What others may write to still stays (see `remove`).

    Raises:
        RuntimeFailure: The engine does not answer.
    """
    with engine.asked():
        label = [f"{OWNER}={owner}"] if data else [f"{OWNER}={owner}", INSTANCE]
        api = engine.api()
        left = api.volumes({"label": label, "dangling": True})["Volumes"] or ()
        used = api.volumes({"label": [f"{OWNER}={owner}"], "dangling": False})["Volumes"] if left else ()
        names = {volume["Name"] for volume in used or ()}
        for volume in left:
            if (volume.get("Labels") or {}).get(BESIDE) not in names:
                remove_volume(engine, volume["Name"])


class Scales:
    """Knows which volumes hold more than they may. Safe from any thread."""

    def __init__(self, engine: Engine, owner: str, data_mb: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._engine = engine
        self._owner = owner
        self._data_mb = data_mb
        self._now_and_then = NowAndThen("docker-volumes", _EVERY_S, clock, self._weigh_quietly)
        self.sizes: Mapping[str, int] = {}
        """Bytes by volume, as weighed last; of the whole engine."""
        self.by_robot: Mapping[str, int] = {}
        """Bytes in this owner's volumes of data: summed up once, for each pass over each site asks."""
        self._unknown: Mapping[str, int] = {}
        """By volume, how many weighings in a row could not look at all that is in there."""
        self._failures = 0
        """In a row."""

    def exceeds(self, data: str, others: Iterable[str] = ()) -> str:
        """Why who writes to a volume of data, and to others of its container, may do so no more; empty: it may."""
        if self.sizes.get(data, 0) > self._data_mb << 20:
            most = f"{self._data_mb} MiB in the volume {data} (the site's data_mb)"
            return f"has more than {most}: delete what is not needed"
        for name in (data, *others):
            # Folders so deep that they have no path keep the engine from looking; what is beside them weighs nothing.
            if self._unknown.get(name, 0) >= _UNKNOWN:
                return f"has made the volume {name} such that the engine cannot tell how much is in there: delete it"
        if any(self.sizes.get(name, 0) > _OWN_MB << 20 for name in others):
            return f"has more than {_OWN_MB} MiB in a volume that is not for data"
        return ""

    def begin(self) -> None:
        """Weigh them, unless that is under way or was done a moment ago. Does not wait."""
        self._now_and_then.begin()

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
            told = sizes(document(said.content))
        self._unknown = {name: self._unknown.get(name, 0) + 1 for name, size in told.items() if size < 0}
        # What was known of these stays known.
        self.sizes = {name: size if size >= 0 else self.sizes.get(name, 0) for name, size in told.items()}
        self.by_robot = stored_by_robot(self._owner, self.sizes)
