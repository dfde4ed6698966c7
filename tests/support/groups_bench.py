"""One orchestrator's groups of sites over a made-up cloud, a step at a time, and killed wherever a test wants."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from skytether.api.groups import GroupCreate, Stage
from skytether.api.rest import State
from skytether.orchestrator.config.settings import ServerLimits, Timing, Weights
from skytether.orchestrator.domain.records import Change, Record
from skytether.orchestrator.domain.security import Secrets
from skytether.orchestrator.groups.demand import Demand
from skytether.orchestrator.groups.groups import Groups
from skytether.orchestrator.groups.scaler import Scaler
from skytether.orchestrator.providers.base import Invitation, Provider
from skytether.orchestrator.runtimes.base import Capacity, Runtime, RuntimeFailure
from skytether.orchestrator.scheduling.catalog import Catalog
from skytether.orchestrator.scheduling.passes import Passes
from skytether.orchestrator.scheduling.placer import Placer
from skytether.orchestrator.scheduling.site import Site
from skytether.orchestrator.scheduling.sites import Sites
from skytether.orchestrator.store.leader import ALONE, Lead
from skytether.orchestrator.store.store import Store
from skytether.orchestrator.telemetry.metrics import Metrics
from skytether.testing.providers import FakeCloud, FakeProvider
from skytether.testing.runtimes import FakeRuntime, FakeWorld


def _look(site: Site) -> float:
    """A site's first look, as its thread makes it; all others are steps of the test."""
    with contextlib.suppress(RuntimeFailure):
        site.capacity = site.runtime.capacity()
        site.looked_at = time.monotonic()
    return 3600.0


class GroupsBench:
    """No thread acts; what is at the sites and in the cloud outlives ``restart``."""

    def __init__(self, folder: Path, store: Store, clock: Any, new_record: Callable[..., Record]) -> None:
        self.folder, self.store, self.clock, self.new_record = folder, store, clock, new_record
        self.cloud = FakeCloud()
        self.worlds: dict[str, FakeWorld] = {}
        """By site."""
        self.silent: set[str] = set()
        """Sites that do not answer."""
        self.offered: int | None = None
        """MiB that a machine is said to have; None: as many as it has."""
        self.refusing: str | None = None
        """Why the sites' runtime cannot run anything."""
        self.lead: Lead = ALONE
        self.start()

    def start(self) -> None:
        clock, store = self.clock, self.store
        self.metrics = Metrics(list, 64)
        self.sites = Sites(self.folder / "sites", store, Timing(site_silent=1e9), self._runtime)
        self.groups = Groups(self.folder / "groups", store, self._provider)
        self.demand = Demand(store, self.groups, self.sites, clock, Weights(), steady=clock.steady)
        self.placer = Placer(
            store,
            self.sites,
            Weights(),
            self.lead,
            clock.steady,
            prospects=self.demand.prospects,
        )
        self.passes = Passes(
            store,
            Catalog(store),
            self.sites,
            self.placer,
            Secrets(self.folder),
            self.metrics,
            Timing(),
            ServerLimits(),
            Weights(),
            clock,
            lambda: None,
            self.lead,
            clock.steady,
        )
        self.scaler = Scaler(
            store,
            self.sites,
            self.passes.successors,
            self.demand,
            self.placer.promised,
            self.lead,
            clock,
            lambda machine, group, options: Invitation("https://orchestrator", f"token-of-{machine}"),
            steady=clock.steady,
        )
        self.sites.start(_look, local=False)
        for site in self.sites.all():
            site.loop.wait_first(10.0)
        self.groups.start(lambda _: 3600.0)

    def restart(self) -> None:
        """It was killed, and the next one comes."""
        self.stop()
        self.start()

    def stop(self) -> None:
        self.groups.stop()
        self.sites.stop()

    def _runtime(self, name: str) -> type[Runtime]:
        bench = self

        class There(FakeRuntime):
            def __init__(self, site: str, folder: Any, options: Any) -> None:
                super().__init__(site, folder, options, bench.worlds.setdefault(site, FakeWorld()))

            def refuses(self, spec: Any) -> str | None:
                return bench.refusing or super().refuses(spec)

            def _answer(self) -> None:
                self.silent = self.site in bench.silent
                super()._answer()

        return There

    def _provider(self, name: str) -> type[Provider]:
        bench = self

        class InCloud(FakeProvider):
            def __init__(self, group: str, owner: str, folder: Any, options: Any) -> None:
                super().__init__(group, owner, folder, options, bench.cloud)

            def offer(self) -> Capacity:
                offer = super().offer()
                return replace(offer, memory_mb=bench.offered or offer.memory_mb)

        return InCloud

    def group(self, name: str = "cloud", **more: Any) -> None:
        given = {"name": name, "provider": "fake", "max": 3, "grow_after_s": 0, "idle_s": 60, **more}
        self.groups.add(GroupCreate.model_validate(given))

    def ask(self, *ids: str, cpu: float = 4.0, **more: Any) -> None:
        """Robots ask for instances; each fills a machine."""
        for id_ in ids:
            spec = {"entrypoint": "skytether.testing.toy_service", "needs": {"cpu": cpu, **more}}
            manifest = {"apiVersion": "skytether.io/v1", "kind": "Service", "metadata": {"name": "toy"}, "spec": spec}
            record = self.new_record(
                id_, robot=f"robot-{id_}", manifest=manifest, lease_s=1e6, lease_expires_at=self.clock() + 1e6
            )
            self.store.add(record, "", None, "")

    def end(self, *ids: str) -> None:
        for id_ in ids:
            record = self.store.get(id_)
            assert record is not None
            self.store.change(Change(record, {"state": State.STOPPING, "stopping_at": self.clock()}), self.clock())

    def step(self, times: int = 1, seconds: float = 1.0) -> None:
        """Time goes by, and every thread has its turn."""
        for _ in range(times):
            self.clock.forward(seconds)
            self.groups.refresh()
            self.passes.placement.step()
            for site in self.sites.all():
                if site.ender is not None:
                    site.ender.join()
            for site in self.sites.all():
                self.passes.reconciler.site_step(site)
            for group in self.groups.all():
                self.scaler.turn(group)
            for site in self.sites.all():
                self.passes.reconciler.site_step(site)

    def stages(self) -> list[Stage]:
        return [machine.stage for machine in self.store.machines()]

    def states(self) -> dict[str, str]:
        return {record.id: record.state.value for record in self.store.live()}

    def site_of(self, instance: str) -> str | None:
        record = self.store.get(instance)
        return record.site if record else None

    def site(self, name: str) -> Site | None:
        return self.sites.find(name)

    def told(self, group: str = "cloud") -> list[str]:
        row = self.store.site_group(group)
        return [text for _, text in row.told] if row else []
