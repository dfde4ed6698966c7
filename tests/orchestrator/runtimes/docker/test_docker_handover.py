"""What an orchestrator that ends, or is followed, leaves to the next one, and what that sees: no engine needed."""

from __future__ import annotations

import base64
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any, ClassVar

import pytest

from skytether.api.grant import Grant
from skytether.api.manifest import ServiceSpec
from skytether.orchestrator.runtimes.base import Launch, OvertakenError, Phase
from skytether.orchestrator.runtimes.docker import DockerRuntime
from skytether.orchestrator.runtimes.docker import launch as docker_launch
from skytether.orchestrator.runtimes.docker import runtime as docker_runtime
from skytether.orchestrator.runtimes.docker.engine import EngineGoneError
from skytether.orchestrator.runtimes.docker.follow import Follower
from skytether.orchestrator.runtimes.docker.launch import Job
from skytether.orchestrator.runtimes.docker.namespaces import Namespaces
from skytether.orchestrator.runtimes.docker.objects import INSTANCE, OWNER, Namespace
from skytether.orchestrator.runtimes.docker.options import DockerOptions
from skytether.orchestrator.runtimes.docker.seen import ContainerState, Helper

PATIENCE = 10.0


class Scene:
    """An engine at which one start is under way: all that is asked of it, and what happens while it begins."""

    def __init__(self) -> None:
        self.calls: list[str] = []
        self.meanwhile: Callable[[], None] = lambda: None
        self.overtaken = False

    def asked(self) -> Any:
        return nullcontext()

    def api(self, _timeout_s: float | None = None) -> Any:
        return self

    def inspect_image(self, _image: str) -> dict[str, Any]:
        return {"Config": {}}

    def create_container_from_config(self, _body: object, _name: str) -> dict[str, str]:
        self.calls.append("create")
        return {"Id": "c1"}

    def put_archive(self, *_: object) -> None:
        self.calls.append("put")

    def start(self, _container: str) -> None:
        self.calls.append("start")
        self.meanwhile()

    def kill(self, _container: str, signal: str) -> None:
        self.calls.append(f"kill {signal}")

    def remove_container(self, container: str, **_: object) -> None:
        self.calls.append("remove")

    # The follower and the fence

    def info(self, _timeout_s: float) -> dict[str, Any]:
        return {"NCPU": 2}

    def seen(self, _timeout_s: float) -> list[ContainerState]:
        return []

    def of(self, _instance: str) -> list[ContainerState]:
        return []

    def shares(self, _container: str) -> bool:
        return False

    def inspect(self, container: str) -> ContainerState:
        return ContainerState(container, "i1", 1, "running")

    def forget(self, _container: str) -> None:
        """Nothing is remembered."""

    def doubt(self, _error: object) -> None:
        """Nor is anything believed."""

    epoch = 1

    def must_lead(self, _epoch: int | None = None) -> None:
        if self.overtaken:
            raise OvertakenError("another orchestrator leads by now")

    def job(self) -> Job:
        key = base64.b64encode(bytes(32)).decode()
        grant = Grant(
            instance="i1", service="toy", robot="walker", session_id="00112233445566aa", session_key=key, topics=()
        )
        launch = Launch(1, ServiceSpec.model_validate({"image": "toy"}), grant)
        me: Any = self
        return Job(launch, me, DockerOptions(), "me", me, lambda **_: None, me, me, None)


@pytest.fixture
def scene(monkeypatch: pytest.MonkeyPatch) -> Scene:
    monkeypatch.setattr(docker_launch, "ensure_image", lambda *_: "sha256:1")
    monkeypatch.setattr(docker_launch, "is_ours", lambda *_: False)
    return Scene()


def ended(job: Job) -> Job:
    job.start()
    job.join(PATIENCE)
    assert job.ended
    return job


def test_what_has_begun_runs_on_when_its_orchestrator_ends_and_what_has_not_is_the_next_ones(scene: Scene) -> None:
    job = scene.job()
    scene.meanwhile = job.leave
    ended(job)
    assert scene.calls == ["create", "put", "put", "start"], "the next leader may say of it already that it runs"
    assert not job.failure

    scene.calls.clear()
    late = scene.job()
    late.leave()
    ended(late)
    assert scene.calls == []
    assert (late.unanswered, late.failure) == (True, "")


def test_what_was_made_is_not_begun_any_more_when_its_orchestrator_ends(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = scene.job()
    monkeypatch.setattr(scene, "put_archive", lambda *_: job.leave())
    ended(job)
    assert scene.calls == ["create", "remove"]
    assert (job.unanswered, job.failure) == (True, "")


def test_an_orchestrator_that_ends_waits_for_its_starts_and_cancels_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, scene: Scene
) -> None:
    monkeypatch.setattr(Follower, "start", lambda _: None)
    runtime = DockerRuntime("edge", tmp_path, DockerOptions(engine=f"unix://{tmp_path}/none", prepared=0))
    job = runtime.jobs["i1"] = scene.job()
    begins, told = threading.Event(), threading.Event()
    leave = job.leave
    was_over: list[bool] = []
    monkeypatch.setattr(job, "leave", lambda: (leave(), told.set()))
    monkeypatch.setattr(runtime.namespaces, "close", lambda: was_over.append(job.ended))

    def meanwhile() -> None:
        begins.set()
        assert told.wait(PATIENCE)

    scene.meanwhile = meanwhile
    job.start()
    assert begins.wait(PATIENCE)
    runtime.close()
    assert was_over == [True], "or the network that its container has joined would seem to be nobody's"
    assert scene.calls == ["create", "put", "put", "start"]


@pytest.mark.parametrize("overtaken", [True, False])
def test_a_begin_without_an_answer_is_undone_only_by_who_leads(scene: Scene, overtaken: bool) -> None:
    """The engine may have begun it, and a later leader adopted it."""

    def meanwhile() -> None:
        scene.overtaken = overtaken
        raise EngineGoneError("timed out")

    scene.meanwhile = meanwhile
    job = ended(scene.job())
    assert scene.calls == ["create", "put", "put", "start"] + ["remove"] * (not overtaken)
    assert (job.unanswered, job.failure, job.given_up) == (True, "", set() if overtaken else {"c1"})


@pytest.mark.parametrize("overtaken", [True, False])
def test_an_end_that_was_asked_for_while_it_began_is_carried_out_only_by_who_leads(
    scene: Scene, overtaken: bool
) -> None:
    job = scene.job()

    def meanwhile() -> None:
        scene.overtaken = overtaken
        job.cancel()

    scene.meanwhile = meanwhile
    ended(job)
    assert scene.calls == ["create", "put", "put", "start"] + ["kill KILL"] * (not overtaken)


@pytest.mark.parametrize("overtaken", [True, False])
def test_a_network_in_which_a_container_is_or_is_just_begun_stays_when_its_orchestrator_ends(overtaken: bool) -> None:
    """That container need not have been seen yet; one that no start uses any more is removed."""

    class Prepared(Scene):
        there: ClassVar = {name: Helper(name, True, "") for name in ("begun", "failed", "late", "ready")}
        seen_by_now = False

        def helpers(self) -> dict[str, Helper]:
            return self.there

        def catch_up(self, _timeout_s: float) -> None:
            self.seen_by_now = True

        def seen(self, _timeout_s: float) -> list[ContainerState]:
            return [ContainerState("c1", "i1", 1, "running", namespace="late")] * self.seen_by_now

        def remove_container(self, container: str, **_: object) -> None:
            self.calls.append(container)

    scene: Any = Prepared()
    pool = Namespaces(scene, DockerOptions(), "me", scene, lambda: None, scene.must_lead)
    ready = [Namespace(name, name, 7600) for name in scene.there]
    pool._ready, pool._mine = ready, set(scene.there)  # noqa: SLF001 as if it had made them
    scene.overtaken = overtaken
    with pool.taken() as begun:
        assert begun is not None
        for name in ("failed", "late"):  # and the second answers too late
            with pool.taken() as given:
                assert given is not None
                assert given.name == name
        pool.close()
    assert scene.calls == ([] if overtaken else ["failed", "ready"])


class Busy:
    """An engine whose look at a container takes until ``go_on``; ``there`` are its containers, with their states."""

    base_url, api_version, timeout = "http://engine", "1.41", 1.0

    def __init__(self) -> None:
        self.there = {"c0": "exited"}
        self.looks, self.go_on = threading.Event(), threading.Event()

    @contextmanager
    def asked(self) -> Iterator[None]:
        yield

    def api(self, _timeout_s: float | None = None) -> Busy:
        return self

    def drop(self) -> None:
        """No connection is held."""

    def info(self) -> dict[str, Any]:
        return {
            "NCPU": 4,
            "MemTotal": 8 << 30,
            "Architecture": "x86_64",
            "SystemTime": "2026-07-24T12:00:00.000000000Z",
        }

    def containers(self, **_: Any) -> list[dict[str, Any]]:
        return [{"Id": name, "Labels": {INSTANCE: name}, "State": state} for name, state in self.there.items()]

    def inspect_container(self, container: str) -> dict[str, Any]:
        status = self.there[container]
        if threading.current_thread().name in ("docker-events", "late"):
            self.looks.set()
            assert self.go_on.wait(PATIENCE)
        labels = {INSTANCE: container, OWNER: "me", "skytether.io/attempt": "1", "skytether.io/port": "7600"}
        return {
            "Id": container,
            "Config": {"Labels": labels},
            "HostConfig": {"Memory": 0},
            "NetworkSettings": {"Ports": {}},
            "Mounts": [],
            "State": {"Status": status, "ExitCode": 0, "OOMKilled": False},
        }

    def logs(self, *_: Any, **__: Any) -> bytes:
        return b""

    def events(self, **_: Any) -> list[Any]:
        return []

    def stats(self, *_: Any, **__: Any) -> list[Any]:
        return []

    def head(self, *_: Any, **__: Any) -> Any:
        return type("Answer", (), {"status_code": 200})

    def volumes(self, _wanted: object) -> dict[str, Any]:
        return {"Volumes": None}

    def create_volume(self, _name: str, labels: dict[str, str]) -> None:
        """Nobody else is there to see it."""


@pytest.fixture
def busy() -> Iterator[Busy]:
    made = Busy()
    yield made
    made.go_on.set()


def test_a_leader_begins_with_a_list_of_its_own_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, busy: Busy
) -> None:
    """The first look at a busy engine took 40 s: what had begun since seemed to be gone."""
    engine: Any = busy
    monkeypatch.setattr(Follower, "start", lambda _: None)
    monkeypatch.setattr(docker_runtime, "Engine", lambda *_: engine)
    monkeypatch.setattr(DockerRuntime, "prepare_early", lambda _: None)
    options = DockerOptions(engine=f"unix://{tmp_path}/none", owner="me", prepared=0)
    runtime = DockerRuntime("edge", tmp_path, options)
    first = threading.Thread(target=runtime.follower.follow, name="docker-events")
    first.start()
    assert busy.looks.wait(PATIENCE)
    busy.there["c1"] = "running"  # the leader before has begun it
    busy.go_on.set()
    runtime.lead(2)
    seen = runtime.observe()["c1"]
    assert (seen.attempt, seen.phase is not Phase.EXITED) == (1, True)
    first.join(PATIENCE)
    runtime.close()


@pytest.mark.parametrize("gone", [False, True])
def test_a_look_that_comes_late_does_not_hide_what_a_later_one_has_seen(busy: Busy, gone: bool) -> None:
    engine: Any = busy
    follower = Follower(engine, "me", lambda: None, 5.0)
    busy.there["c1"] = "created"
    late = threading.Thread(target=follower.inspect, args=("c1",), name="late")
    late.start()
    assert busy.looks.wait(PATIENCE)
    busy.there["c1"] = "exited"
    follower.inspect("c1")
    if gone:
        follower.forget("c1")
    busy.go_on.set()
    late.join(PATIENCE)
    assert [seen.status for seen in follower.of("c1")] == ([] if gone else ["exited"])
    follower.inspect("c1")
    assert [seen.status for seen in follower.of("c1")] == ["exited"], "as another list shows it"
    follower.close()
