"""All that acts on instances, over one placer, put together: standbys, successors, leases and the two passes."""

from __future__ import annotations

import time
from collections.abc import Callable

from skytether.api.rest import Size

from ..access.disk_usage import DiskUsage
from ..config.settings import ServerLimits, Timing, Weights
from ..domain.overload import Overload
from ..domain.security import Secrets
from ..store.leader import ALONE, Lead
from ..store.store import Store
from ..telemetry.metrics import Metrics
from .catalog import Catalog
from .leases import Leases
from .placement_pass import PlacementPass
from .placer import Placer
from .reconcile import PLENTY, Reconciler
from .sites import Sites
from .standbys import Standbys
from .successors import Successors


class Passes:
    """The pass over what has no site, the passes over sites, and what they share."""

    def __init__(
        self,
        store: Store,
        catalog: Catalog,
        sites: Sites,
        placer: Placer,
        secrets: Secrets,
        metrics: Metrics,
        timing: Timing,
        limits: ServerLimits,
        weights: Weights,
        clock: Callable[[], float],
        wake_placer: Callable[[], None],
        lead: Lead = ALONE,
        steady: Callable[[], float] = time.monotonic,
        overload: Overload | None = None,
        disk_usage: DiskUsage | None = None,
        left: Callable[[str], Size] = lambda _: PLENTY,
    ) -> None:
        """``clock`` gives seconds since the epoch, ``steady`` those of a clock that nobody sets.

        ``wake_placer`` is called when there is room for another. ``left``: what a robot may have beside what it has.
        """
        self.standbys = Standbys(store, catalog, sites, placer, clock, timing, weights)
        self.successors = Successors(store, sites, placer, self.standbys, clock, timing, weights)
        self.leases = Leases(store, clock, timing.place, self._clock_was_set, lead, steady, overload)
        shared = self.leases, self.standbys, self.successors, metrics, timing
        self.placement = PlacementPass(store, sites, placer, *shared, limits, clock, steady)
        self.reconciler = Reconciler(
            store, secrets, placer, *shared, clock, wake_placer, lead, steady, disk_usage=disk_usage, left=left
        )

    def _clock_was_set(self) -> None:
        self.standbys.clock_was_set()
        self.successors.clock_was_set()
