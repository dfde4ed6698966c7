"""What each runtime of ours brings to the contract's suite. A new runtime adds a kit, and nothing else."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from kubernetes_site import LITTLE

from skytether.api.grant import GRANT_VARIABLE
from skytether.orchestrator.runtimes.base import Launch, Runtime
from skytether.orchestrator.runtimes.process import ProcessOptions, ProcessRuntime
from skytether.orchestrator.runtimes.procfs import ProcessStat
from skytether.testing.runtime_contract import RuntimeKit
from skytether.testing.runtimes import (
    CrashingRuntime,
    FakeOptions,
    FakeRuntime,
    FakeWorld,
    SlowRuntime,
    StubbornRuntime,
)


class ProcessKit(RuntimeKit):
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


class DockerKit(RuntimeKit):
    def __init__(self, folder: Path, site: Any) -> None:
        super().__init__(folder)
        self.site = site
        self.image = self.site.images.toy

    def open(self, behaviour: str = "good") -> Runtime:
        runtime = self.site.open(self.folder)
        self.runtimes.append(runtime)
        return runtime

    def running(self, instance: str = "i1") -> int:
        return len(self.site.labelled(f"skytether.io/instance={instance}", "status=running"))


class KubernetesKit(RuntimeKit):
    patience = 90.0

    def __init__(self, folder: Path, site: Any) -> None:
        super().__init__(folder)
        self.site = site
        self.image = self.site.images.toy

    def open(self, behaviour: str = "good") -> Runtime:
        runtime = self.site.open(self.folder)
        self.runtimes.append(runtime)
        return runtime

    def launch(self, instance: str = "i1", attempt: int = 1, behaviour: str = "good") -> Launch:
        asked = super().launch(instance, attempt, behaviour)
        needs = asked.spec.needs.model_copy(update=LITTLE)
        return replace(asked, spec=asked.spec.model_copy(update={"needs": needs}))

    def running(self, instance: str = "i1") -> int:
        pods = self.site.there("pods", f"skytether.io/instance={instance}")
        states = [one["state"] for pod in pods for one in pod["status"].get("containerStatuses", ())]
        return sum("running" in state for state in states)


class FakeKit(RuntimeKit):
    kind: type[FakeRuntime] = FakeRuntime

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.world = FakeWorld()

    def open(self, behaviour: str = "good") -> Runtime:
        kinds: dict[str, Callable[..., Runtime]] = {
            "good": self.kind,
            "stubborn": StubbornRuntime,
            "crashing": CrashingRuntime,
        }
        runtime = kinds[behaviour]("lab", self.folder, FakeOptions(), self.world)
        self.runtimes.append(runtime)
        return runtime

    def running(self, instance: str = "i1") -> int:
        return int(instance in self.world and not self.world[instance].ended)


class SlowKit(FakeKit):
    kind = SlowRuntime


@pytest.fixture(
    params=[
        pytest.param((ProcessKit, ""), id="process", marks=pytest.mark.slow),
        pytest.param((DockerKit, "docker_site"), id="docker", marks=[pytest.mark.slow, pytest.mark.docker]),
        pytest.param(
            (KubernetesKit, "kubernetes_site"),
            id="kubernetes",
            marks=[pytest.mark.slow, pytest.mark.docker, pytest.mark.kubernetes],
        ),
        pytest.param((FakeKit, ""), id="fake"),
        pytest.param((SlowKit, ""), id="slow"),
    ]
)
def kit(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[RuntimeKit]:
    kind, site = request.param
    kit = kind(tmp_path, request.getfixturevalue(site)) if site else kind(tmp_path)
    yield kit
    kit.close()
