"""What each runtime brings to the contract's suite. A new runtime adds a kit, and nothing else."""

from __future__ import annotations

import base64
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from skytether.api.grant import GRANT_VARIABLE, Grant
from skytether.api.manifest import ServiceSpec
from skytether.orchestrator.runtimes.base import Launch, Observation, Phase, Runtime
from skytether.orchestrator.runtimes.process import ProcessOptions, ProcessRuntime
from skytether.orchestrator.runtimes.procfs import ProcessStat
from skytether.testing.runtimes import (
    CrashingRuntime,
    FakeOptions,
    FakeRuntime,
    FakeWorld,
    SlowRuntime,
    StubbornRuntime,
)

TOY = "skytether.testing.toy_service"


class Kit(ABC):
    """One kind of runtime, and how to get services of it that behave in a certain way."""

    patience = 30.0
    """Seconds that a run may take to become what it should."""
    image = "toy"

    def __init__(self, folder: Path, request: pytest.FixtureRequest) -> None:
        self.folder = folder
        self.runtimes: list[Runtime] = []

    @abstractmethod
    def open(self, behaviour: str = "good") -> Runtime:
        """A runtime over the same site each time; ``good``, ``stubborn`` or ``crashing`` services."""

    @abstractmethod
    def running(self, instance: str = "i1") -> int:
        """How many runs of an instance the machine has now, whatever any runtime says."""

    def launch(self, instance: str = "i1", attempt: int = 1, behaviour: str = "good") -> Launch:
        params: dict[str, Any] = {
            "good": {"say": f"run {attempt}", "report": f"run {attempt} is up"},
            "stubborn": {"ignore_sigterm": True},
            "crashing": {"exit_status": 1, "say": "boom"},
        }[behaviour]
        grant = Grant(
            instance=instance,
            service="toy",
            robot="walker",
            params=params,
            session_id="00112233445566aa",
            session_key=base64.b64encode(bytes(range(32))).decode(),
            topics=(),
        )
        return Launch(attempt, ServiceSpec(entrypoint=TOY, image=self.image), grant)

    def until(self, runtime: Runtime, phase: Phase | None, instance: str = "i1") -> Observation | None:
        """Look until the instance is in this phase; None: until it is not there."""
        deadline = time.monotonic() + self.patience
        while True:
            seen = runtime.observe().get(instance)
            if (seen and seen.phase) == phase:
                return seen
            assert time.monotonic() < deadline, f"{instance} is {seen}, not {phase}"
            time.sleep(0.005)

    def close(self) -> None:
        """Leave nothing behind."""
        cleaner = self.open()  # of no leader
        for instance in list(cleaner.observe()):
            cleaner.remove(instance)
        for runtime in self.runtimes:
            runtime.observe()  # what it began and another ended is waited for
            runtime.close()


class ProcessKit(Kit):
    def open(self, behaviour: str = "good") -> Runtime:
        runtime = ProcessRuntime("lab", self.folder, ProcessOptions())
        self.runtimes.append(runtime)
        return runtime

    def running(self, instance: str = "i1") -> int:
        wanted = f"{GRANT_VARIABLE}={self.folder}/instances/{instance}/own/grant.json".encode()
        found = 0
        for folder in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):
                stat = ProcessStat.read(int(folder.name))
                leads = stat is not None and not stat.zombie and stat.session == stat.pid
                found += leads and wanted in (folder / "environ").read_bytes().split(b"\0")
        return found


class DockerKit(Kit):
    def __init__(self, folder: Path, request: pytest.FixtureRequest) -> None:
        super().__init__(folder, request)
        self.site: Any = request.getfixturevalue("docker_site")
        self.image = self.site.images.toy

    def open(self, behaviour: str = "good") -> Runtime:
        runtime = self.site.open(self.folder)
        self.runtimes.append(runtime)
        return runtime

    def running(self, instance: str = "i1") -> int:
        return len(self.site.labelled(f"skytether.io/instance={instance}", "status=running"))


class KubernetesKit(Kit):
    patience = 90.0

    def __init__(self, folder: Path, request: pytest.FixtureRequest) -> None:
        super().__init__(folder, request)
        self.site: Any = request.getfixturevalue("kubernetes_site")
        self.image = self.site.images.toy

    def open(self, behaviour: str = "good") -> Runtime:
        runtime = self.site.open(self.folder)
        self.runtimes.append(runtime)
        return runtime

    def running(self, instance: str = "i1") -> int:
        pods = self.site.there("pods", f"skytether.io/instance={instance}")
        states = [one["state"] for pod in pods for one in pod["status"].get("containerStatuses", ())]
        return sum("running" in state for state in states)


class FakeKit(Kit):
    kind: type[FakeRuntime] = FakeRuntime

    def __init__(self, folder: Path, request: pytest.FixtureRequest) -> None:
        super().__init__(folder, request)
        self.world = FakeWorld()

    def open(self, behaviour: str = "good") -> Runtime:
        kind = {"good": self.kind, "stubborn": StubbornRuntime, "crashing": CrashingRuntime}[behaviour]
        runtime = kind("lab", self.folder, FakeOptions(), self.world)
        self.runtimes.append(runtime)
        return runtime

    def running(self, instance: str = "i1") -> int:
        return int(instance in self.world and not self.world[instance].ended)


class SlowKit(FakeKit):
    kind = SlowRuntime


@pytest.fixture(
    params=[
        pytest.param(ProcessKit, id="process", marks=pytest.mark.slow),
        pytest.param(DockerKit, id="docker", marks=[pytest.mark.slow, pytest.mark.docker]),
        pytest.param(
            KubernetesKit, id="kubernetes", marks=[pytest.mark.slow, pytest.mark.docker, pytest.mark.kubernetes]
        ),
        pytest.param(FakeKit, id="fake"),
        pytest.param(SlowKit, id="slow"),
    ]
)
def kit(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Kit]:
    kit = request.param(tmp_path, request)
    yield kit
    kit.close()
