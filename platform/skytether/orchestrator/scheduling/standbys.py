"""Standbys: instances that run already, are nobody's, and wait for a robot.

A request with the same parameters gets one as its own; so does the robot of an instance that crashed, or whose site
does not answer.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from skytether.api.manifest import Manifest
from skytether.api.rest import State

from ..config.settings import Timing, Weights
from ..domain.errors import InvalidError
from ..domain.records import Record, new_record
from ..domain.transitions import stopping
from ..domain.validation import check_params
from ..store.store import Store
from .catalog import Catalog
from .placer import Placer
from .site import about_to_end, reachable
from .sites import Sites

FOREVER = 2.5e11
"""End of a standby's lease: a date that can be written (the year 9892)."""
_SETTLED = 30.0
"""Seconds that a standby with other parameters is kept: robots that ask for different ones must not wear it out."""


class Standbys:
    """Which there are, which are to be, and whose they could be."""

    def __init__(
        self,
        store: Store,
        catalog: Catalog,
        sites: Sites,
        placer: Placer,
        clock: Callable[[], float],
        timing: Timing,
        weights: Weights,
    ) -> None:
        """``clock`` gives seconds since the epoch."""
        self._store = store
        self._catalog = catalog
        self._sites = sites
        self._placer = placer
        self._clock = clock
        self._timing = timing
        self._weights = weights
        self._not_before: dict[str, float] = {}
        """By service: no standby before this, because the last one failed."""
        self.warms = True
        """Whether any service has standbys, or is to have some, as of the last look."""

    def fitting(self, record: Record) -> list[Record]:
        """Warm instances that could be this one, the best site's first; none at a site that is much worse."""
        same = [standby for standby in self._store.standbys(record.service) if _alike(standby, record)]
        if not same:
            return []
        others = self._placer.promised(same)
        scores = {score.site: score.total_ms for score in self._placer.weigh(record, others, runs=True).scores}
        cold = (score.total_ms for score in self._placer.weigh(record, others).scores)
        limit = min(cold, default=math.inf) + self._weights.migrate_ms
        at = {s.id: self._sites.find(s.site) for s in same}
        here = [s for s in same if reachable(at[s.id]) and not about_to_end(at[s.id], s.id)]
        good = [s for s in here if s.site in scores and scores[s.site] <= limit]
        return sorted(good, key=lambda standby: (scores[standby.site or ""], standby.created_at))

    def keep(self) -> None:
        """Start those that are missing, and end those that nobody would get."""
        now = self._clock()
        kept: dict[str, int] = {}
        catalog = {manifest.metadata.name: manifest for manifest in self._catalog.all()}
        standbys = self._store.live_standbys()
        self.warms = bool(standbys) or any(manifest.spec.needs.standby for manifest in catalog.values())
        for standby in standbys:
            if standby.state is State.STOPPING:
                continue
            manifest = catalog.get(standby.service)
            wanted = manifest.spec.needs.standby if manifest else 0
            current = manifest is not None and _document(manifest) == standby.manifest
            if current and (self._stale(standby, now) or self._leaves(standby)):
                current = False
            if current and kept.get(standby.service, 0) < wanted:
                kept[standby.service] = kept.get(standby.service, 0) + 1
            else:
                self._end(standby, now)
        for name, manifest in catalog.items():
            if kept.get(name, 0) < manifest.spec.needs.standby and now >= self._not_before.get(name, 0.0):
                self._add(manifest, now)

    def _stale(self, standby: Record, now: float) -> bool:
        """It has other parameters than the last request, and has had its time."""
        params = self._store.last_params(standby.service)
        return params is not None and params != standby.params and abs(now - standby.created_at) > _SETTLED

    def _add(self, manifest: Manifest, now: float) -> None:
        name = manifest.metadata.name
        params = self._store.last_params(name) or {}
        try:
            check_params(params, manifest.spec.params, name)
        except InvalidError:
            return  # parameters are needed, and nobody has asked yet
        standby = new_record(
            robot="",
            service=name,
            manifest=_document(manifest),
            params=params,
            created_at=now,
            updated_at=now,
            lease_s=self._timing.standby_lease,
            lease_expires_at=FOREVER,
            standby=True,
        )
        # Robots come first: a standby does not wait for room.
        if self._placer.weigh(standby, self._placer.promised()).site is not None:
            self._store.add(standby, "", None, "")

    def _end(self, standby: Record, now: float) -> None:
        self._store.change(stopping(standby, now, "this standby is not needed any more"), now)

    def failed(self, record: Record) -> None:
        """Do not try another one at once."""
        self._not_before[record.service] = self._clock() + self._timing.backoff_max

    def clock_was_set(self) -> None:
        """Nothing is known any more of how long things have been as they are."""
        self._not_before = {}

    def _leaves(self, standby: Record) -> bool:
        """Its site takes nothing more, or is about to end it."""
        site = self._sites.find(standby.site)
        return site is not None and (site.draining or site.evacuating or about_to_end(site, standby.id) != "")


def _alike(standby: Record, record: Record) -> bool:
    """Same service, same version, same parameters."""
    return (standby.service, standby.manifest, standby.params) == (record.service, record.manifest, record.params)


def _document(manifest: Manifest) -> dict[str, Any]:
    return manifest.model_dump(mode="json", by_alias=True)
