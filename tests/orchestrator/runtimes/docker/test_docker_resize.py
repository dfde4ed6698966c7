"""What a real engine's containers may take is changed while they run."""

from __future__ import annotations

import json
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from docker_site import DockerSite
from engine_ways import EngineProxy

from skytether.api.grant import Grant
from skytether.api.manifest import Manifest, ServiceSpec
from skytether.api.rest import InstanceCreate, Resize, SiteCreate, Size, State
from skytether.orchestrator.access.access import Principal
from skytether.orchestrator.config.settings import Settings
from skytether.orchestrator.core import Orchestrator
from skytether.orchestrator.domain.errors import InvalidError, NoSiteError
from skytether.orchestrator.domain.records import Record
from skytether.orchestrator.runtimes.base import Launch, OvertakenError, Phase, Runtime, RuntimeFailure
from skytether.orchestrator.runtimes.docker import DockerRuntime
from skytether.orchestrator.scheduling.runtime_entry_points import load_runtime

pytestmark = [pytest.mark.docker, pytest.mark.slow]

OPERATOR = Principal(None)
PATIENCE = 60.0


def until(condition: Callable[[], Any]) -> Any:
    deadline = time.monotonic() + PATIENCE
    while not (found := condition()):
        assert time.monotonic() < deadline
        time.sleep(0.02)
    return found


def docker(*arguments: str) -> str:
    return subprocess.run(["docker", *arguments], check=True, capture_output=True, text=True).stdout.strip()


def inspected(container: str) -> Any:
    return json.loads(docker("inspect", container))[0]


def held(container: str) -> tuple[int, int, int]:
    """MiB of memory, and with swap; thousandths of cores."""
    host = inspected(container)["HostConfig"]
    return host["Memory"] >> 20, host["MemorySwap"] >> 20, host["NanoCpus"] // 1_000_000


def in_force(container: str) -> str:
    """As the kernel has it, in the container's own control group."""
    read = "cat /sys/fs/cgroup/memory.max 2>/dev/null || cat /sys/fs/cgroup/memory/memory.limit_in_bytes"
    return docker("exec", container, "sh", "-c", read)


def find(name: str) -> type[Runtime]:
    return DockerRuntime if name == "docker" else load_runtime(name)


class House:
    """An orchestrator with one Docker site, behind a way to the engine that can be cut."""

    def __init__(self, folder: Path, docker: DockerSite, proxy: EngineProxy) -> None:
        self.folder, self.docker, self.proxy = folder, docker, proxy
        self.core = self._open()
        options = {**docker.options(), "engine": proxy.engine, "timeout_s": 5, "cpu": 4}
        self.core.sites.add(SiteCreate(name="edge", tier="edge", runtime="docker", options=options))
        self.core.sites.delete("local")
        toy = {"image": docker.images.toy, "params": {"type": "object", "additionalProperties": True}}
        toy |= {"needs": {"cpu": 0.5, "memory_mb": 128}}
        document = {"apiVersion": "skytether.io/v1", "kind": "Service", "metadata": {"name": "toy"}, "spec": toy}
        self.core.catalog.put("toy", Manifest.model_validate(document))

    def _open(self) -> Orchestrator:
        core = Orchestrator(Settings(state_dir=self.folder), find_runtime=find)
        core.start()
        return core

    def restart(self) -> None:
        self.core.stop()
        self.core = self._open()

    def ask(self, **params: Any) -> str:
        asked = InstanceCreate(robot="walker", service="toy", lease_s=600, params=params)
        made = self.core.instances.create(OPERATOR, asked, None).id
        until(lambda: self.record(made).state is State.RUNNING)
        return made

    def record(self, instance: str) -> Record:
        return self.core.instances.get(OPERATOR, instance)

    def resize(self, instance: str, **asked: Any) -> Record:
        return self.core.instances.resize(OPERATOR, instance, Resize(**asked))

    def told(self, instance: str) -> list[str]:
        return [event.reason for event in self.core.store.events(instance, 0) if event.reason.startswith("has ")]


@pytest.fixture
def house(tmp_path: Path, docker_site: DockerSite) -> Iterator[House]:
    proxy = EngineProxy(tmp_path / "engine.sock")
    proxy.start()
    house = House(tmp_path / "state", docker_site, proxy)
    yield house
    house.core.stop()
    proxy.cut()


def test_limits_change_in_the_kernel_and_the_process_stays_the_same(house: House) -> None:
    instance = house.ask()
    (container,) = house.docker.containers()
    before = inspected(container)["State"]
    assert held(container) == (128, 128, 1000)
    house.resize(instance, cpu=2, memory_mb=512)
    until(lambda: house.record(instance).has == Size(cpu=2, memory_mb=512))
    assert held(container) == (512, 512, 2000)
    assert in_force(container) == str(512 << 20)
    house.resize(instance, cpu=0.5, memory_mb=96)
    until(lambda: house.record(instance).has.memory_mb == 96)
    assert held(container) == (96, 96, 1000)
    assert in_force(container) == str(96 << 20)
    after = inspected(container)["State"]
    assert (after["Pid"], after["StartedAt"], after["Running"]) == (before["Pid"], before["StartedAt"], True)
    assert len(house.told(instance)) == 2
    assert house.record(instance).attempt == 1


def test_what_it_uses_is_not_taken_from_it_and_more_than_there_is_not_given(house: House) -> None:
    instance = house.ask(hog_mb=60)
    site = house.core.sites.get("edge")
    until(lambda: (site.observed[instance].memory_bytes or 0) > 60 << 20)
    with pytest.raises(InvalidError, match="and it uses"):
        house.resize(instance, memory_mb=64)
    with pytest.raises(NoSiteError, match="needs 16 cores, the site has 4"):
        house.resize(instance, cpu=16)
    with pytest.raises(RuntimeFailure, match="it uses"):
        site.runtime.resize(instance, 1, house.record(instance).sized(Size(cpu=1, memory_mb=64)))
    (container,) = house.docker.containers()
    assert held(container) == (128, 128, 1000)
    assert site.runtime.observe()[instance].phase is Phase.RUNNING


def test_an_engine_that_is_away_meanwhile_is_asked_when_it_is_back_and_a_new_leader_goes_on(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    instance = house.ask()
    (container,) = house.docker.containers()
    site = house.core.sites.get("edge")
    cutting = threading.Event()
    resize = site.runtime.resize

    def cut_in_between(*arguments: Any) -> bool:
        if not cutting.is_set():
            cutting.set()
            house.proxy.cut()
        return resize(*arguments)

    monkeypatch.setattr(site.runtime, "resize", cut_in_between)
    house.resize(instance, cpu=2)
    until(cutting.is_set)
    until(lambda: site.unreachable)
    assert house.record(instance).wants == Size(cpu=2, memory_mb=128)
    house.restart()
    house.proxy.start()
    until(lambda: house.record(instance).has == Size(cpu=2, memory_mb=128))
    assert held(container) == (128, 128, 2000)
    assert len(house.told(instance)) == 1
    assert house.record(instance).attempt == 1
    docker("kill", container)  # and the next run has it, too
    until(lambda: house.record(instance).attempt == 2 and house.record(instance).state is State.RUNNING)
    newest = house.core.sites.get("edge").runtime.observe()[instance]
    assert newest.attempt == 2
    again = docker("ps", "-q", "--filter", f"label=skytether.io/instance={instance}")
    assert held(again) == (128, 128, 2000)


def test_a_change_by_somebody_else_is_overruled(house: House) -> None:
    instance = house.ask()
    (container,) = house.docker.containers()
    house.resize(instance, memory_mb=256)
    until(lambda: house.record(instance).has.memory_mb == 256)
    docker("update", "--memory", "512m", "--memory-swap", "512m", container)
    until(lambda: held(container)[0] == 256)
    assert len(house.told(instance)) == 1


def test_an_instance_that_is_busy_gets_more_within_its_bounds(house: House) -> None:
    toy = house.core.catalog.get("toy").model_dump(mode="json", by_alias=True)
    # Little, for the machine may be busy with other things: what a container does not get it does not use.
    toy["spec"]["needs"] |= {"cpu": 0.05, "scaling": {"cpu": {"min": 0.05, "max": 0.2}}}
    house.core.catalog.put("toy", Manifest.model_validate(toy))
    instance = house.ask()
    (container,) = house.docker.containers()
    docker("exec", "-d", container, "sh", "-c", "while :; do :; done & while :; do :; done")
    until(lambda: house.record(instance).has.cpu == 0.2)
    assert inspected(container)["HostConfig"]["CpuShares"] == 2048
    assert house.record(instance).attempt == 1
    assert all("cores are busy" in text for text in house.told(instance))


def test_a_leader_that_was_followed_changes_nothing(docker_site: DockerSite, tmp_path: Path) -> None:
    first, second = docker_site.open(tmp_path), docker_site.open(tmp_path)
    try:
        first.lead(5)
        first.start(launch(docker_site))
        until(lambda: first.observe()["i1"].phase is Phase.RUNNING)
        second.lead(6)
        spec = launch(docker_site).spec
        with pytest.raises(OvertakenError):
            first.resize("i1", 1, spec.sized(2, 512))
        assert second.resize("i1", 1, spec.sized(2, 512))
    finally:
        second.remove("i1")
        first.close()
        second.close()


def launch(site: DockerSite) -> Launch:
    key = "AAECAwQFBgcICQoLDA0ODxAREhMUFRYXGBkaGxwdHh8="
    grant = Grant(instance="i1", service="toy", robot="r", session_id="00112233445566aa", session_key=key, topics=())
    return Launch(1, ServiceSpec(image=site.images.toy), grant)
