"""A reconciler of which a test makes the steps: made-up time, a real store, a runtime that runs nothing."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from skytether.api.rest import SiteCreate
from skytether.orchestrator.config.settings import Limits, Timing, Weights
from skytether.orchestrator.domain.overload import Overload
from skytether.orchestrator.domain.records import Record
from skytether.orchestrator.domain.security import Secrets
from skytether.orchestrator.scheduling.catalog import Catalog
from skytether.orchestrator.scheduling.moves import Moves
from skytether.orchestrator.scheduling.reconcile import Reconciler
from skytether.orchestrator.scheduling.sites import Site
from skytether.orchestrator.store.store import Store
from skytether.orchestrator.telemetry.metrics import Metrics
from skytether.testing.runtimes import FakeOptions, FakeRuntime


class FixedSites:
    """Sites whose threads never run: the test makes the steps."""

    def __init__(self, *sites: Site) -> None:
        self._sites = {site.name: site for site in sites}

    def all(self) -> list[Site]:
        return list(self._sites.values())

    def find(self, name: str | None) -> Site | None:
        return self._sites.get(name or "")

    def refresh(self) -> None:
        """Nobody adds or deletes any."""

    def end_drained(self, *_: Any) -> None:
        """None is drained."""


class Bench:
    """A reconciler over one site, ``lab``; a test may add others."""

    def __init__(self, folder: Path, store: Store, clock: Any, kind: type[FakeRuntime] = FakeRuntime, **options: Any):
        self.store, self.clock = store, clock
        self.woken = 0
        self.metrics = Metrics(list, 64)
        self.overload = Overload(clock.steady)
        self.reconciler = self._reconciler(folder)
        self.runtime = kind("lab", folder, FakeOptions(**options))
        self.site = self._site()

    def _reconciler(self, folder: Path) -> Reconciler:
        return Reconciler(
            self.store,
            Secrets(folder),
            self.metrics,
            Timing(),
            Limits(ended_count=1),
            Weights(),
            self.clock,
            self._wake,
            steady=self.clock.steady,
            overload=self.overload,
        )

    def _site(self) -> Site:
        asked = SiteCreate(name="lab", tier="edge", runtime="fake")
        site = Site(asked, self.runtime, self.reconciler.site_step, Timing(site_silent=1e9))
        self._let_know(site)
        reconciler, catalog, sites = self.reconciler, Catalog(self.store), self.reconciler.sites
        reconciler.moves = Moves(
            self.store, catalog, lambda: sites, reconciler.weigh, reconciler.promised, self.clock, Timing(), Weights()
        )
        return site

    def _let_know(self, *sites: Site) -> None:
        self.reconciler.sites = FixedSites(*sites)  # type: ignore[assignment]

    def beside(self, folder: Path, kind: type[FakeRuntime] = FakeRuntime, **options: Any) -> Site:
        """Another site, ``other``; at equal scores it comes second."""
        asked = SiteCreate(name="other", tier="edge", runtime="fake")
        runtime = kind("other", folder, FakeOptions(**options))
        other = Site(asked, runtime, self.reconciler.site_step, Timing(site_silent=1e9))
        self._let_know(self.site, other)
        self.reconciler.site_step(other)
        return other

    def _wake(self) -> None:
        self.woken += 1

    def restart(self, folder: Path) -> None:
        """The orchestrator is killed and comes back; what runs runs on."""
        self.runtime = type(self.runtime)("lab", folder, FakeOptions(), self.runtime.world)
        self.overload = Overload(self.clock.steady)
        self.reconciler = self._reconciler(folder)
        self.site = self._site()

    def step(self, times: int = 1) -> float:
        for _ in range(times):
            self.reconciler.place_step()
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
