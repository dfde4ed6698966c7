"""The passes of which a test makes the steps: made-up time, a real store, a runtime that runs nothing."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from skytether.api.rest import SiteCreate, Size
from skytether.orchestrator.config.settings import ServerLimits, Timing, Weights
from skytether.orchestrator.domain.overload import Overload
from skytether.orchestrator.domain.records import Record
from skytether.orchestrator.domain.security import Secrets
from skytether.orchestrator.scheduling.catalog import Catalog
from skytether.orchestrator.scheduling.passes import Passes
from skytether.orchestrator.scheduling.placer import Placer
from skytether.orchestrator.scheduling.reconcile import PLENTY
from skytether.orchestrator.scheduling.site import Site
from skytether.orchestrator.store.leader import ALONE, Lead
from skytether.orchestrator.store.store import Store
from skytether.orchestrator.telemetry.metrics import Metrics
from skytether.testing.runtimes import FakeOptions, FakeRuntime


class FixedSites:
    """Sites whose threads never run: the test makes the steps."""

    def __init__(self) -> None:
        self._sites: dict[str, Site] = {}

    def add(self, site: Site) -> None:
        """There is another one."""
        self._sites[site.name] = site

    def all(self) -> list[Site]:
        return list(self._sites.values())

    def find(self, name: str | None) -> Site | None:
        return self._sites.get(name or "")

    def refresh(self) -> None:
        """Nobody adds or deletes any."""

    def end_drained(self, *_: Any) -> None:
        """None is drained."""


class Bench:
    """Passes over one site, ``lab``; a test may add others."""

    def __init__(self, folder: Path, store: Store, clock: Any, kind: type[FakeRuntime] = FakeRuntime, **options: Any):
        self.store, self.clock = store, clock
        self.folder = folder
        self.woken = 0
        self.metrics = Metrics(list, 64)
        self.overload = Overload(clock.steady)
        self.limits = ServerLimits(ended_count=1)
        self.lead: Lead = ALONE
        self.left: Callable[[str], Size] = lambda _: PLENTY
        self.sites = FixedSites()
        self.runtime = kind("lab", folder, FakeOptions(**options))
        self._start()
        self.site = self._site("lab", self.runtime)

    def _start(self) -> None:
        sites: Any = self.sites
        self.placer = Placer(self.store, sites, Weights(), self.lead, self.clock.steady)
        passes = Passes(
            self.store,
            Catalog(self.store),
            sites,
            self.placer,
            Secrets(self.folder),
            self.metrics,
            Timing(),
            self.limits,
            Weights(),
            self.clock,
            self._wake,
            self.lead,
            self.clock.steady,
            self.overload,
            left=lambda robot: self.left(robot),
        )
        self.placement, self.reconciler, self.leases = passes.placement, passes.reconciler, passes.leases
        self.standbys, self.successors = passes.standbys, passes.successors

    def _site(self, name: str, runtime: FakeRuntime) -> Site:
        asked = SiteCreate(name=name, tier="edge", runtime="fake")
        site = Site(asked, runtime, lambda site: self.reconciler.site_step(site), Timing(site_silent=1e9))
        self.sites.add(site)
        return site

    def led_by(self, lead: Lead, limits: ServerLimits | None = None) -> None:
        """Begin anew, over the same sites, as who leads by this."""
        self.lead, self.limits = lead, limits or self.limits
        self._start()

    def beside(self, folder: Path, kind: type[FakeRuntime] = FakeRuntime, **options: Any) -> Site:
        """Another site, ``other``; at equal scores it comes second."""
        other = self._site("other", kind("other", folder, FakeOptions(**options)))
        self.reconciler.site_step(other)
        return other

    def _wake(self) -> None:
        self.woken += 1

    def restart(self, folder: Path) -> None:
        """The orchestrator is killed and comes back; what runs runs on."""
        self.runtime = type(self.runtime)("lab", folder, FakeOptions(), self.runtime.world)
        self.overload = Overload(self.clock.steady)
        self.folder, self.sites = folder, FixedSites()
        self._start()
        self.site = self._site("lab", self.runtime)

    def step(self, times: int = 1) -> float:
        for _ in range(times):
            self.placement.step()
            delay = self.reconciler.site_step(self.site)
        return delay

    def record(self, name: str = "i1") -> Record:
        found = self.store.get(name)
        assert found is not None
        return found

    def reasons(self, name: str = "i1") -> list[tuple[str, str]]:
        return [(e.state.value, e.reason) for e in self.store.events(name, 0)]


def add(bench: Bench, record: Record) -> None:
    bench.store.add(record, "operator", None, "")
