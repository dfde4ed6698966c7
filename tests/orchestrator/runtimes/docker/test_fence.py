"""Two orchestrators at one Docker engine, and what is left where one ends in the middle, or somebody removes things."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import closing, nullcontext
from pathlib import Path
from typing import Any

import pytest
from docker.errors import APIError
from docker_runs import docker, launch, until, until_phase
from docker_site import DockerSite

from skytether.orchestrator.runtimes.base import OvertakenError, Phase
from skytether.orchestrator.runtimes.docker import DockerRuntime
from skytether.orchestrator.runtimes.docker import runtime as module
from skytether.orchestrator.runtimes.docker.engine import EngineGoneError
from skytether.orchestrator.runtimes.docker.fence import Fence
from skytether.orchestrator.runtimes.docker.follow import Follower
from skytether.orchestrator.runtimes.docker.launch import START_S
from skytether.orchestrator.runtimes.docker.objects import EPOCH, OWNER
from skytether.orchestrator.runtimes.docker.options import DockerOptions


class Volumes:
    """An engine that has nothing else; removing one that is in use is refused."""

    def __init__(self) -> None:
        self.there: dict[str, dict[str, str]] = {}

    def asked(self) -> Any:
        return nullcontext()

    def api(self) -> Any:
        return self

    def volumes(self, wanted: dict[str, Any]) -> dict[str, Any]:
        owner = wanted["label"][0].partition("=")[2]
        rows = [{"Name": name, "Labels": labels} for name, labels in self.there.items() if labels[OWNER] == owner]
        return {"Volumes": rows or None}

    def create_volume(self, name: str, labels: dict[str, str]) -> None:
        self.there.setdefault(name, labels)

    def remove_volume(self, name: str) -> None:
        if name not in self.there:
            raise APIError("gone", response=type("", (), {"status_code": 404}))  # type: ignore[arg-type]
        del self.there[name]


def test_one_volume_says_who_leads_and_the_earlier_is_refused() -> None:
    volumes: Any = Volumes()
    first, second, other = Fence(volumes, "me"), Fence(volumes, "me"), Fence(volumes, "else")
    first.must_lead()
    other.lead(9)
    first.lead(1)
    first.lead(1)
    second.must_lead()
    second.lead(2)
    assert sorted(volumes.there) == ["skytether-else-epoch-9", "skytether-me-epoch-2"]
    for refused in (first.must_lead, lambda: first.lead(1), lambda: second.must_lead(1)):
        with pytest.raises(OvertakenError):
            refused()
    second.must_lead()
    volumes.there.clear()  # somebody pruned them
    second.lead(2)
    with pytest.raises(OvertakenError):
        first.must_lead()
    first.lead(10)
    with pytest.raises(OvertakenError):
        second.must_lead()
    first.clear()
    assert volumes.there == {}


def test_an_act_that_finds_the_engine_silent_lets_the_next_look_know(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing need start: the events of an engine that hangs are silent, as those of one that rests are."""

    def silent(*_: int) -> None:
        raise EngineGoneError("timed out")

    options = DockerOptions(engine=f"unix://{tmp_path}/none", prepared=0)
    monkeypatch.setattr(Follower, "start", lambda _: None)
    with closing(DockerRuntime("edge", tmp_path, options)) as runtime:
        runtime.follower.looked.set()
        runtime.fence.epoch = 1
        monkeypatch.setattr(runtime.fence, "lead", silent)
        assert runtime.observe() == {}
        with pytest.raises(EngineGoneError):
            runtime.tidy()
        with pytest.raises(EngineGoneError):
            runtime.observe()


@pytest.fixture
def runtimes(docker_site: DockerSite, tmp_path: Path) -> Iterator[tuple[DockerRuntime, DockerRuntime]]:
    with closing(docker_site.open(tmp_path)) as late, closing(docker_site.open(tmp_path, prepared=0)) as leader:
        yield late, leader


class Frozen:
    """Holds up whoever begins a container, before that, until it is told to go on."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, runtime: DockerRuntime) -> None:
        self.reached, self.go_on = threading.Event(), threading.Event()
        api = runtime.engine.api(START_S)
        begin = api.start

        def start(container: str) -> None:
            if threading.current_thread().name == "docker-start":
                self.reached.set()
                assert self.go_on.wait(30)
            begin(container)

        monkeypatch.setattr(api, "start", start)


@pytest.mark.docker
@pytest.mark.slow
@pytest.mark.parametrize("wanted", [True, False])
def test_a_leader_that_is_frozen_between_its_look_and_its_call(
    docker_site: DockerSite,
    runtimes: tuple[DockerRuntime, DockerRuntime],
    monkeypatch: pytest.MonkeyPatch,
    wanted: bool,
) -> None:
    late, leader = runtimes
    late.lead(1)
    frozen = Frozen(monkeypatch, late)
    late.start(launch(docker_site))
    assert frozen.reached.wait(30)
    (made,) = docker_site.containers()
    assert docker("inspect", "-f", f'{{{{index .Config.Labels "{EPOCH}"}}}}', made) == "1"
    leader.lead(2)
    if wanted:
        leader.start(launch(docker_site))
        until_phase(leader, Phase.RUNNING)
    else:
        leader.remove("i1")
        until(lambda: leader.tidy() or not docker_site.containers())
    frozen.go_on.set()
    late.jobs["i1"].join(30)
    assert late.jobs["i1"].ended
    assert made not in docker_site.containers()
    assert len(docker_site.containers()) == wanted
    assert len(docker_site.volumes_with("skytether.io/instance")) == wanted
    with pytest.raises(OvertakenError):
        late.stop("i1", force=True)
    assert len(docker_site.labelled("skytether.io/instance", "status=running")) == wanted


@pytest.mark.docker
@pytest.mark.slow
def test_what_a_late_leader_has_begun_beside_a_later_run_is_ended(
    docker_site: DockerSite, runtimes: tuple[DockerRuntime, DockerRuntime]
) -> None:
    leader = runtimes[1]
    leader.lead(2)
    leader.start(launch(docker_site, attempt=2))
    until_phase(leader, Phase.RUNNING)
    labels = f"{OWNER}={docker_site.owner}", "skytether.io/instance=i1", "skytether.io/attempt=1"
    command = ["run", "-d", *(f"--label={label}" for label in labels), "--entrypoint", "sleep"]
    docker(*command, docker_site.images.name("guard"), "600")
    running = "skytether.io/instance", "status=running"
    assert len(docker_site.labelled(*running)) == 2
    until(lambda: leader.tidy() or len(docker_site.labelled(*running)) == 1)
    assert until_phase(leader, Phase.RUNNING).attempt == 2


@pytest.mark.docker
@pytest.mark.slow
def test_nothing_is_left_of_a_container_that_somebody_removed(
    docker_site: DockerSite, runtimes: tuple[DockerRuntime, DockerRuntime], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "SWEEP_S", 0.0)
    leader = runtimes[1]
    image = f"{docker_site.images.prefix}declares:1"
    recipe = f"FROM {docker_site.images.toy}\nVOLUME /more /run/skytether /tmp\n"
    subprocess.run(["docker", "build", "-q", "-t", image, "-"], input=recipe, text=True, check=True)
    leader.start(launch(docker_site, image=image))
    leader.start(launch(docker_site, "i2"))
    until_phase(leader, Phase.RUNNING)
    until_phase(leader, Phase.RUNNING, "i2")
    assert len(docker_site.volumes_with("skytether.io/instance=i1")) == 2
    (container,) = docker_site.labelled("skytether.io/instance=i1")
    docker("rm", "-f", container)
    assert len(docker_site.volumes_with("skytether.io/instance=i1")) == 2, "with the key in one of them"
    until(lambda: "i1" not in leader.observe())
    leader.tidy()
    assert len(docker_site.volumes_with("skytether.io/instance=i1")) == 2, "the other one may have folders of these"
    leader.remove("i2")
    until(lambda: leader.tidy() or not docker_site.volumes_with("skytether.io/instance=i1"))
    assert docker_site.volumes_with("skytether.io/instance=i2") == []
    assert len(docker_site.volumes()) == 1
    leader.start(launch(docker_site, image=image))  # the same attempt: nothing of it is there
    until_phase(leader, Phase.RUNNING)
    leader.remove("i1")
    assert docker_site.volumes_with("skytether.io/instance") == []
    docker("image", "rm", "-f", image)


KILLED = """
import itertools, os, sys, threading
from pathlib import Path
import requests
sys.path.insert(0, sys.argv[1])
from docker_runs import launch
from docker_site import DockerSite, Images

site = DockerSite(Images(sys.argv[3], [], Path()))
site.network, site.owner = sys.argv[4:6]
runtime = site.open(Path(sys.argv[2]))
runtime.lead(1)
until, done, lock, threads = int(sys.argv[6]), [], threading.Lock(), {}
send = requests.Session.send

def counted(self, request, **more):
    answer = None
    if threading.current_thread().name == "docker-start":
        with lock:
            mine = threads.setdefault(threading.current_thread(), [len(threads) + 1, 0])
        mine[1] += 1
        answer = send(self, request, **more)
        if mine[1] >= mine[0]:  # the first thread ends after its first call, the second after its second
            done.append(mine)
            threading.Event().wait()
    return answer if answer is not None else send(self, request, **more)

requests.Session.send = counted
for number in range(until):
    runtime.start(launch(site, f"i{number}"))
for job in list(runtime.jobs.values()):
    while not job.ended and not any(threads.get(job._thread) is one for one in done):
        job.join(0.02)
print(max(calls for _, calls in threads.values()), flush=True)
os._exit(9)
"""


@pytest.mark.docker
@pytest.mark.slow
def test_an_orchestrator_that_is_killed_between_any_two_calls_leaves_nothing_that_is_not_found(
    docker_site: DockerSite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "SWEEP_S", 0.0)
    calls = 30
    here = str(Path(__file__).parents[3] / "support")
    given = here, tmp_path, docker_site.images.prefix, docker_site.network, docker_site.owner, calls
    done = subprocess.run([sys.executable, "-c", KILLED, *map(str, given)], stdout=subprocess.PIPE, text=True)
    assert done.returncode == 9
    assert int(done.stdout) < calls, "not every call was the last one of a start"
    with closing(docker_site.open(tmp_path, prepared=0)) as leader:
        leader.lead(2)
        for number in range(calls):
            leader.remove(f"i{number}")
        until(lambda: leader.tidy() or not docker_site.containers() + docker_site.helpers())
        leader.tidy()
        assert docker_site.volumes_with("skytether.io/instance") == []
        assert docker_site.volumes_with(EPOCH) == [f"skytether-{docker_site.owner}-epoch-2"]
        leader.dismantle()
        assert docker_site.volumes_with() == docker_site.volumes()
