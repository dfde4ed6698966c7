"""One site: its runtime, its thread, and what is known of it now."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Collection, Mapping

from skytether.api.manifest import ServiceSpec
from skytether.api.rest import SiteCreate

from ..config.settings import Timing
from ..runtimes.base import Capacity, Observation, Runtime
from .fitness import Fitness
from .loops import Loop
from .placement import NOTHING, Candidate

Step = Callable[["Site"], float]
"""One reconcile pass over a site; returns seconds until the next."""


class Site:
    """One site: its runtime, and what is known of it now. Read from any thread, written by its own."""

    def __init__(self, asked: SiteCreate, runtime: Runtime, step: Step, timing: Timing) -> None:
        self.asked = asked
        self.runtime = runtime
        self.fitness = Fitness(timing.backoff_max, timing.unfit_max)
        """What it failed to start: only the orchestrator that leads knows."""
        self.capacity: Capacity | None = None
        self.load: float | None = None
        """Share of its processors that is busy; None: not known."""
        self.failure = ""
        """Why the last look failed; empty: it did not."""
        self.balks = 0
        """Passes in a row that looked, and were then not answered, or overtaken, when they acted."""
        self.rests_until = -math.inf
        """Steady seconds: it answered nothing, and whoever calls meanwhile does not have it asked again."""
        self.observed: Mapping[str, Observation] = {}
        self.looked_at = -math.inf
        """Monotonic seconds of the last look that did not fail."""
        self.seen_since: tuple[int, float] | None = None
        """Since when it has answered each time, after how many settings of the clock; None: it does not answer."""
        self.hosted: frozenset[str] | None = None
        """Robots that have, or had, an instance here, as far as the store knows; None: it was not asked yet."""
        self.ended: frozenset[str] = frozenset()
        """Those of the observed that the store knows as ended."""
        self.leaving: Mapping[str, str] = {}
        """Of the observed those that the site is about to end, and why."""
        self.awaited: Collection[str] | None = None
        """What starts or stops here, all of it seen as ``observed`` has it and dealt with; None: not known."""
        self.draining = False
        """It takes no more instances, and is deleted with its last one."""
        self.group = ""
        """Whose machine it is, for whoever leads; empty: of no group."""
        self.evacuating = False
        """It takes no more instances, and those that are there are moved elsewhere."""
        self.called = False
        """Somebody started or ended an instance here since the last pass began."""
        self.passed_at = -math.inf
        """Seconds of the reconciler's steady clock: when the last whole pass ended; minus infinity: with something left
        to do, or not at all."""
        self.watched_at = -math.inf
        """The same of the last look at all that is here."""
        self.pass_took = self.look_took = 0.0
        """Seconds of a processor that both took."""
        self.tidied_at = -math.inf
        self.ender: threading.Thread | None = None
        """Deletes it, once it is drained."""
        self.led = 0
        """Epoch of the leader as whose its runtime was last told to act; 0: nobody's."""
        self.loop = Loop(f"site-{asked.name}", lambda: step(self), time.monotonic)
        self._silent_after = timing.site_silent

    @property
    def name(self) -> str:
        return self.asked.name

    def wake(self) -> None:
        """Look at once at what starts or stops here; from any thread."""
        self.called = True
        self.loop.wake()

    @property
    def unreachable(self) -> str:
        """Why it cannot be used now; empty: it can."""
        silent = time.monotonic() - self.looked_at
        if self.failure or silent < self._silent_after:
            return self.failure
        return f"it has not answered for {silent:.0f} s" if self.capacity else "it has not answered yet"

    def candidate(
        self, spec: ServiceSpec, used: Capacity, unstarted: str | None = None, unfit: str | None = None
    ) -> Candidate:
        """As placement sees it for one service.

        Args:
            spec: The service.
            used: What the instances that are here asked for.
            unstarted: Why this very instance could not be started here.
            unfit: Why none of the service is to be, for a while.
        """
        return Candidate(
            name=self.name,
            tier=self.asked.tier,
            cannot_run=self.runtime.refuses(spec),
            draining=self.draining or self.evacuating,
            unstarted=unstarted,
            unfit=unfit,
            unreachable=self.unreachable or None,
            blocked=self.runtime.blocked() or None,
            total=self.capacity or NOTHING,
            used=used,
            load=self.load or 0.0,
            speed=self.asked.speed,
            cost=self.asked.cost,
            images=self.asked.images,
            fills=bool(self.group),
        )


def reachable(site: Site | None) -> bool:
    """Whether there is one that can be used now."""
    return site is not None and not site.unreachable


def about_to_end(site: Site | None, instance: str) -> str:
    """Why a site is about to end an instance; empty: it is not."""
    if site is None:
        return ""
    drained = f"site {site.name} is being drained" if site.evacuating else ""
    return site.leaving.get(instance, "") or drained
