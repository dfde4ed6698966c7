from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

import pytest

from skytether.api.rest import SiteCreate
from skytether.orchestrator.config.settings import Settings, Timing
from skytether.orchestrator.core import Orchestrator
from skytether.orchestrator.domain.errors import ConflictError, InvalidError
from skytether.orchestrator.runtimes.base import Observation, Phase, Runtime
from skytether.orchestrator.runtimes.process import ProcessRuntime
from skytether.orchestrator.scheduling import runtime_entry_points as module
from skytether.orchestrator.scheduling.runtime_entry_points import load_runtime
from skytether.orchestrator.store.leader import fenced
from skytether.orchestrator.store.store import Store
from skytether.testing.runtimes import FakeOptions, FakeRun, FakeRuntime, FakeWorld

Start = Callable[..., Orchestrator]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    started: list[Orchestrator] = []

    def make(find: Any = lambda _: FakeRuntime, timing: Timing = Timing()) -> Orchestrator:  # noqa: B008
        started.append(Orchestrator(Settings(state_dir=tmp_path, timing=timing), find_runtime=find))
        started[-1].start()
        return started[-1]

    yield make
    for one in started:
        one.stop()


def stored(folder: Path, *sites: SiteCreate) -> None:
    store = Store(f"sqlite:///{folder}/state.db")
    store.migrate()
    for site in sites:
        store.add_site(site)
    store.close()


def test_runtimes_are_found_by_entry_point(monkeypatch: pytest.MonkeyPatch) -> None:
    assert load_runtime("process") is ProcessRuntime
    points = [
        EntryPoint("gone", "no_such_module:X", module.RUNTIMES),
        EntryPoint("odd", "pathlib:Path", module.RUNTIMES),
    ]
    monkeypatch.setattr(module, "entry_points", lambda **_: points)
    with pytest.raises(InvalidError, match="there is no runtime 'x'; installed are: gone, odd"):
        load_runtime("x")
    with pytest.raises(InvalidError, match="'gone' cannot be used: No module named 'no_such_module'"):
        load_runtime("gone")
    with pytest.raises(InvalidError, match="entry point 'odd' is no Runtime"):
        load_runtime("odd")


def test_there_is_a_local_site_of_tier_edge_unless_there_is_another(start: Start, tmp_path: Path) -> None:
    core = start()
    assert [(s.asked.name, s.asked.tier, s.asked.runtime) for s in core.sites.all()] == [("local", "edge", "process")]
    assert core.sites.get("local").unreachable == ""
    core.sites.add(SiteCreate(name="mine", tier="cloud", runtime="fake"))
    core.sites.delete("local")
    core.stop()
    assert [s.name for s in start().sites.all()] == ["mine"]


def test_a_site_whose_runtime_is_gone_is_listed_with_the_reason_and_can_be_deleted(
    start: Start, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    stored(tmp_path, SiteCreate(name="old", tier="edge", runtime="dokcer"))
    core = start(find=load_runtime)
    site = core.sites.get("old")
    installed = ", ".join(sorted(point.name for point in entry_points(group=module.RUNTIMES)))
    assert site.unreachable == f"runtime: there is no runtime 'dokcer'; installed are: {installed}"
    assert "site old cannot be used" in caplog.text
    core.sites.delete("old")
    assert core.sites.all() == []


def test_what_ended_instances_left_goes_with_their_site(start: Start) -> None:
    did: list[str] = []

    class Tidy(FakeRuntime):
        def observe(self) -> Any:
            return {"ended": Observation(1, Phase.EXITED)}

        def remove(self, instance: str) -> None:
            did.append(f"removed {instance}")

        def dismantle(self) -> None:
            did.append("dismantled")

    core = start(find=lambda _: Tidy)
    core.sites.add(SiteCreate(name="mine", tier="cloud", runtime="tidy"))
    core.sites.delete("local")
    core.sites.get("mine").loop.stop(5)  # the reconciler knows no such instance, and would remove it too
    did.clear()
    core.sites.delete("mine")
    assert did == ["removed ended", "dismantled"]


def test_a_site_is_emptied_also_by_one_that_led_there_before(start: Start) -> None:
    worlds: dict[str, FakeWorld] = {}

    class Shared(FakeRuntime):
        def __init__(self, site: str, folder: Path, options: Any) -> None:
            super().__init__(site, folder, options, worlds.setdefault(site, FakeWorld()))

        def observe(self) -> Any:
            return {"ended": Observation(1, Phase.EXITED)} if "ended" in self.world else {}

    core = start(find=lambda _: Shared)
    site = core.sites.add(SiteCreate(name="mine", tier="cloud", runtime="shared"))
    site.loop.stop(5)
    site.runtime.lead(10**10)
    worlds["mine"].epoch += 1  # another one leads by now
    worlds["mine"]["ended"] = FakeRun(None, 1)  # type: ignore[arg-type]
    core.sites.delete("mine")
    assert not worlds["mine"]


class OwnedOptions(FakeOptions):
    owner: str = ""


class OwningRuntime(FakeRuntime):
    Options = OwnedOptions
    unique = "owner"


def test_two_sites_with_the_same_instances_are_refused(start: Start) -> None:
    core = start(find=lambda _: OwningRuntime)
    for name, owner in (("a", "me"), ("b", "other")):
        core.sites.add(SiteCreate(name=name, tier="edge", runtime="owning", options={"owner": owner}))
    with pytest.raises(ConflictError, match="site 'a' has the same option 'owner': each would end the other's"):
        core.sites.add(SiteCreate(name="c", tier="edge", runtime="owning", options={"owner": "me"}))


def test_a_site_that_hangs_is_unreachable_and_holds_up_no_other(start: Start, tmp_path: Path) -> None:
    stored(
        tmp_path, SiteCreate(name="hangs", tier="edge", runtime="h"), SiteCreate(name="works", tier="edge", runtime="w")
    )

    class HangingRuntime(FakeRuntime):
        def observe(self) -> Any:
            time.sleep(0.3)
            return super().observe()

    kinds: dict[str, type[Runtime]] = {"h": HangingRuntime, "w": FakeRuntime}
    core = start(find=kinds.__getitem__, timing=Timing(observe=0.01, site_silent=0.15))
    hangs, works = core.sites.get("hangs"), core.sites.get("works")
    deadline = time.monotonic() + 5
    while "it has not answered for" not in hangs.unreachable:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    assert works.unreachable == ""


def test_a_reconciler_that_hangs_is_not_ready(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    core = start()
    assert core.not_ready() == ""
    core.placer.stop(5)
    core.placer.last_pass -= 31
    assert core.not_ready() == "the reconciler has made no pass for 31 s"


def test_a_drained_site_is_not_deleted_for_a_leader_that_was_followed(start: Start, tmp_path: Path) -> None:
    stored(tmp_path, SiteCreate(name="lab", tier="edge", runtime="fake"))
    one = start()
    one.placer.stop(timeout=5.0)
    site = one.sites.get("lab")
    site.draining = True
    with fenced(1):  # by now the epoch is the present time
        one.sites.end_drained((), list)
    assert site.ender is not None
    site.ender.join()
    assert [there.name for there in one.store.sites()] == ["lab"]
