"""What runs at a process site leave behind when they have ended."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from skytether.api.grant import Grant
from skytether.api.manifest import ServiceSpec
from skytether.orchestrator.runtimes.base import Launch, Observation, Phase
from skytether.orchestrator.runtimes.process import ProcessOptions, ProcessRuntime
from skytether.orchestrator.runtimes.procfs import ProcessStat

pytestmark = pytest.mark.slow


def launch(attempt: int = 1, **params: Any) -> Launch:
    grant = Grant(
        instance="i1",
        service="toy",
        robot="walker",
        params=params,
        session_id="00112233445566aa",
        session_key="A" * 43 + "=",
        topics=(),
    )
    return Launch(attempt, ServiceSpec(entrypoint="skytether.testing.toy_service"), grant)


@pytest.fixture
def runtime(tmp_path: Path) -> Iterator[ProcessRuntime]:
    made = ProcessRuntime("lab", tmp_path, ProcessOptions())
    yield made
    made.remove("i1")
    made.close()


def until(runtime: ProcessRuntime, phase: Phase) -> Observation:
    deadline = time.monotonic() + 30
    while (seen := runtime.observe()["i1"]).phase is not phase:
        assert time.monotonic() < deadline, seen
        time.sleep(0.002)
    return seen


def test_what_a_run_wrote_into_its_own_folder_goes_when_it_has_ended(runtime: ProcessRuntime, tmp_path: Path) -> None:
    runtime.start(launch(report="this is known"))
    port = until(runtime, Phase.RUNNING).port
    own, data = tmp_path / "instances/i1/own", tmp_path / "data/walker/toy/i1"
    (own / "deep/er").mkdir(parents=True)
    for folder in (own, own / "deep/er", data):
        (folder / "large").write_bytes(bytes(1 << 20))
    runtime.tidy()
    assert (own / "large").exists()
    runtime.stop("i1", force=True)
    until(runtime, Phase.EXITED)
    runtime.tidy()
    assert sorted(os.listdir(own)) == ["ready.json", "reports.json"]
    assert (data / "large").exists()
    assert runtime.logs("i1", 9).startswith("toy service")
    # Whoever leads next reads what it reported, and where it listened.
    other = ProcessRuntime("lab", tmp_path, ProcessOptions())
    assert [report.message for report in other.observe()["i1"].reports] == ["this is known"]
    other.close()
    runtime.start(launch(attempt=2))
    assert until(runtime, Phase.RUNNING).port == port


def test_what_it_left_running_ends_and_writes_no_more(runtime: ProcessRuntime, tmp_path: Path) -> None:
    runtime.start(launch(child=True))
    until(runtime, Phase.RUNNING)
    log = runtime.logs("i1", 9).splitlines()
    child = int(next(line for line in log if line.startswith("child ")).removeprefix("child "))
    note = (tmp_path / "instances/i1/run.json").read_text()
    os.kill(int(note.partition('"process": [')[2].partition(",")[0]), signal.SIGKILL)
    until(runtime, Phase.EXITED)
    runtime.tidy()
    deadline = time.monotonic() + 30
    while (stat := ProcessStat.read(child)) is not None and not stat.zombie:
        assert time.monotonic() < deadline
        time.sleep(0.002)


def test_a_link_that_a_service_made_is_removed_and_nothing_else(runtime: ProcessRuntime, tmp_path: Path) -> None:
    runtime.start(launch())
    until(runtime, Phase.RUNNING)
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere/kept").touch()
    own = tmp_path / "instances/i1/own"
    (own / "link").symlink_to(tmp_path / "elsewhere")
    (own / "reports.json").symlink_to(tmp_path / "elsewhere/kept")
    runtime.stop("i1", force=True)
    until(runtime, Phase.EXITED)
    runtime.tidy()
    assert os.listdir(own) == ["ready.json"]
    assert (tmp_path / "elsewhere/kept").exists()
