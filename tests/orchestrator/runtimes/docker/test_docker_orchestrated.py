"""An orchestrator with a Docker site: what becomes of instances when orchestrator, container or engine fail."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from docker_site import DockerSite
from engine_ways import EngineProxy

from skytether.api.manifest import Manifest
from skytether.api.rest import InstanceCreate, SiteCreate, State
from skytether.orchestrator.access.access import Principal
from skytether.orchestrator.config.settings import Settings
from skytether.orchestrator.core import Orchestrator
from skytether.orchestrator.domain.records import Record
from skytether.orchestrator.runtimes.base import Runtime
from skytether.orchestrator.runtimes.docker import DockerRuntime, runtime
from skytether.orchestrator.scheduling.runtime_entry_points import load_runtime

pytestmark = [pytest.mark.docker, pytest.mark.slow]

OPERATOR = Principal(None)
PATIENCE = 30.0


def find(name: str) -> type[Runtime]:
    return DockerRuntime if name == "docker" else load_runtime(name)


class House:
    """Orchestrators one after the other over one state folder, with one Docker site."""

    def __init__(self, folder: Path, docker: DockerSite, proxy: EngineProxy) -> None:
        self.folder = folder
        self.docker = docker
        self.proxy = proxy
        self.core = self._open()
        options = {**docker.options(), "engine": proxy.engine, "timeout_s": 5}
        self.core.sites.add(SiteCreate(name="edge", tier="edge", runtime="docker", options=options))
        self.core.sites.delete("local")
        toy = {"image": docker.images.toy, "params": {"type": "object", "additionalProperties": True}}
        document = {"apiVersion": "skytether.io/v1", "kind": "Service", "metadata": {"name": "toy"}, "spec": toy}
        self.core.catalog.put("toy", Manifest.model_validate(document))

    def _open(self) -> Orchestrator:
        core = Orchestrator(Settings(state_dir=self.folder), find_runtime=find)
        core.start()
        return core

    def restart(self) -> None:
        self.core.stop()
        self.core = self._open()

    def needs_device(self, path: str) -> None:
        """From now on the toy, which any kind of site can run, needs one."""
        toy = self.core.catalog.get("toy").model_dump(mode="json", by_alias=True)
        toy["spec"] |= {"entrypoint": "skytether.testing.toy_service", "needs": {"devices": [path]}}
        self.core.catalog.put("toy", Manifest.model_validate(toy))

    def end(self, instance: str) -> None:
        self.core.instances.delete(OPERATOR, instance)
        self.until(instance, State.STOPPED)

    def ask(self) -> str:
        asked = InstanceCreate(robot="walker", service="toy", lease_s=600)
        return self.core.instances.create(OPERATOR, asked, None).id

    def record(self, instance: str) -> Record:
        return self.core.instances.get(OPERATOR, instance)

    def until(self, instance: str, state: State, good: Callable[[Record], bool] = lambda _: True) -> Record:
        deadline = time.monotonic() + PATIENCE
        while not ((record := self.record(instance)).state is state and good(record)):
            assert time.monotonic() < deadline, f"{record.state}: {record.reason}"
            time.sleep(0.02)
        return record


@pytest.fixture
def house(tmp_path: Path, docker_site: DockerSite) -> Iterator[House]:
    proxy = EngineProxy(tmp_path / "engine.sock")
    proxy.start()
    house = House(tmp_path / "state", docker_site, proxy)
    yield house
    house.core.stop()
    proxy.cut()


def docker(*arguments: str) -> str:
    return subprocess.run(["docker", *arguments], check=True, capture_output=True, text=True).stdout.strip()


def test_an_instance_outlives_the_orchestrator_and_is_started_again_when_it_dies(house: House) -> None:
    instance = house.ask()
    before = house.until(instance, State.RUNNING)
    containers = house.docker.containers()
    house.restart()
    after = house.until(instance, State.RUNNING)
    assert (after.port, after.attempt, after.restarts) == (before.port, 1, 0)
    assert house.docker.containers() == containers
    docker("kill", *containers)
    again = house.until(instance, State.RUNNING, lambda record: record.attempt == 2)
    assert (again.restarts, again.port) == (1, before.port)
    events: list[Any] = house.core.store.events(instance, 0)
    assert any("was killed by signal 9" in event.reason for event in events)
    house.end(instance)
    assert docker("ps", "-q", "--filter", f"label=skytether.io/instance={instance}") == ""


def test_a_site_without_its_engine_is_unreachable_and_its_instances_wait(house: House) -> None:
    instance = house.ask()
    before = house.until(instance, State.RUNNING)
    house.proxy.cut()
    site = house.core.sites.get("edge")
    deadline = time.monotonic() + PATIENCE
    while not site.unreachable:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    assert "does not answer" in site.unreachable
    waiting = house.ask()
    house.until(waiting, State.PENDING, lambda record: "does not answer" in record.reason)
    assert house.record(instance).state is State.RUNNING
    house.restart()  # a new orchestrator finds the engine away too
    assert house.record(instance).state is State.RUNNING
    house.proxy.start()
    house.until(waiting, State.RUNNING)
    after = house.until(instance, State.RUNNING)
    assert (after.port, after.attempt, after.restarts) == (before.port, 1, 0)
    assert len(house.docker.containers()) == 2


def test_what_a_machine_lacks_another_site_has(house: House) -> None:
    """The device is not plugged in at the first machine; the other site is this machine itself."""
    options = {**house.docker.options(), "owner": f"{house.docker.owner}-bare", "devices": ["/dev/unplugged"]}
    house.core.sites.add(SiteCreate(name="bare", tier="edge", runtime="docker", options=options))
    house.core.sites.add(SiteCreate(name="other", tier="edge", runtime="process"))
    house.needs_device("/dev/unplugged")
    instance = house.ask()
    record = house.until(instance, State.RUNNING)
    refused = {refusal["site"]: refusal for refusal in record.refused}
    assert (record.site, refused["bare"]["reason"]) == ("other", "start")
    assert "no such file or directory; plug it in" in refused["bare"]["detail"]
    events = house.core.store.events(instance, 0)
    assert sum(event.state is State.STARTING and not event.reason for event in events) == 2  # once at each
    house.end(instance)
    left = [f"--filter=label={one}" for one in (f"skytether.io/owner={options['owner']}", "skytether.io/instance")]
    deadline = time.monotonic() + PATIENCE
    while docker("ps", "-aq", *left):
        assert time.monotonic() < deadline
        time.sleep(0.02)
    house.core.sites.delete("bare")


def test_a_site_without_its_guard_says_so_and_starts_what_waits_when_it_is_there(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runtime, "AGAIN_S", 0.2)
    guard, late = house.docker.images.name("guard"), house.docker.images.name("late-guard")
    new = {"owner": f"{house.docker.owner}-late", "network": f"{house.docker.network}-late", "guard_image": late}
    options = house.docker.options(**new, devices=["/dev/null"])
    site = house.core.sites.add(SiteCreate(name="late", tier="edge", runtime="docker", options=options))
    house.needs_device("/dev/null")
    instance = house.ask()
    house.until(instance, State.PENDING, lambda record: "late: the network of the instances cannot" in record.reason)
    assert "build it (`make images`)" in site.runtime.blocked()
    assert not site.unreachable
    docker("tag", guard, late)
    try:
        assert house.until(instance, State.RUNNING).site == "late"
        assert site.runtime.blocked() == ""
        house.end(instance)
        house.core.sites.delete("late")
    finally:
        docker("image", "rm", late)
