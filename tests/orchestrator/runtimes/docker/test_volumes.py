"""What a service has written into its volume, and what becomes of one that wrote too much."""

from __future__ import annotations

import json
import logging
import threading
from contextlib import nullcontext
from typing import Any

import pytest

from skytether.orchestrator.runtimes.base import Phase, RuntimeFailure
from skytether.orchestrator.runtimes.docker.options import DockerOptions
from skytether.orchestrator.runtimes.docker.seen import ContainerState, observation, parse
from skytether.orchestrator.runtimes.docker.volumes import Scales, sizes

DISK = {
    "Volumes": [
        {"Name": "full", "UsageData": {"Size": (2 << 20) + 1, "RefCount": 1}},
        {"Name": "good", "UsageData": {"Size": 2 << 20, "RefCount": 1}},
        {"Name": "elsewhere", "UsageData": {"Size": -1, "RefCount": -1}},
        {"Name": "unknown"},
    ]
}


class FakeEngine:
    """Says what is on its disk, or nothing."""

    base_url, api_version, timeout = "http+docker://localhost", "1.41", 120.0

    def __init__(self) -> None:
        self.disk: dict[str, Any] = dict(DISK)
        self.asks = 0
        self.hangs: threading.Event | None = None
        self.refuses = False

    def asked(self) -> Any:
        return nullcontext()

    def api(self, _timeout_s: float) -> FakeEngine:
        return self

    def get(self, url: str, params: dict[str, str], timeout: float) -> FakeEngine:
        assert url == "http+docker://localhost/v1.41/system/df"
        assert params == {"type": "volume", "verbose": "1"}, "neither images nor layers"
        assert timeout == self.timeout
        self.asks += 1
        if self.hangs is not None:
            self.hangs.wait(30)
        if self.refuses:
            raise RuntimeFailure("no")
        return self

    def raise_for_status(self) -> None:
        """It was answered."""

    @property
    def content(self) -> bytes:
        return json.dumps(self.disk).encode()


def test_what_the_engine_says_of_its_volumes() -> None:
    assert sizes(DISK) == {"full": (2 << 20) + 1, "good": 2 << 20, "elsewhere": -1}
    assert sizes({}) == sizes({"Volumes": None}) == sizes({"VolumeUsage": {"TotalCount": 1}}) == {}
    assert sizes({"VolumeUsage": {"Items": DISK["Volumes"]}}) == sizes(DISK), "from version 1.52 on"


@pytest.mark.parametrize(("told", "known"), [(10**400, 1 << 50), (float("inf"), None), ("7", None)])
def test_of_a_volume_that_no_disk_holds_no_more_is_believed(told: Any, known: int | None) -> None:
    """It would be summed up with what is true, and shown."""
    assert sizes({"Volumes": [{"Name": "odd", "UsageData": {"Size": told}}]}).get("odd") == known


def test_robots_sums_are_made_when_volumes_are_weighed_and_not_when_they_are_asked_for() -> None:
    engine = FakeEngine()
    scales = Scales(engine, "ab", 2)  # type: ignore[arg-type]
    volumes = {"skytether-ab-data-walker-toy": 1, "skytether-ab-data-walker-recorder": 2, "skytether-cd-data-x-toy": 4}
    engine.disk = {"Volumes": [{"Name": name, "UsageData": {"Size": size}} for name, size in volumes.items()]}
    assert scales.by_robot == {}
    scales.weigh()
    assert scales.by_robot == {"walker": 3}


def test_a_volume_that_holds_too_much_is_named_until_there_is_room() -> None:
    engine = FakeEngine()
    scales = Scales(engine, "ab", 2)  # type: ignore[arg-type]
    assert scales.exceeds("full") == "", "not looked at yet"
    scales.weigh()
    assert scales.exceeds("full").startswith("has more than 2 MiB in the volume full (the site's data_mb)")
    assert not any(map(scales.exceeds, ("good", "elsewhere", "unknown", "")))
    assert scales.exceeds("good", ["full"]) == "", "64 MiB are, in each that is not for data"
    engine.disk = {"Volumes": [{"Name": "grant", "UsageData": {"Size": (64 << 20) + 1}}]}
    scales.weigh()
    assert scales.exceeds("full") == ""
    assert scales.exceeds("good", ["", "grant"]) == "has more than 64 MiB in a volume that is not for data"


def test_what_the_engine_cannot_weigh_again_and_again_holds_too_much() -> None:
    """A folder that is too deep to have a path, made by a service, keeps the engine from weighing its volume."""
    engine = FakeEngine()
    scales = Scales(engine, "ab", 2)  # type: ignore[arg-type]

    def weigh(size: int) -> None:
        engine.disk = {"Volumes": [{"Name": "skytether-ab-data-walker-toy", "UsageData": {"Size": size}}]}
        scales.weigh()

    volume = "skytether-ab-data-walker-toy"
    weigh((2 << 20) + 1)
    weigh(-1)
    assert scales.exceeds(volume).startswith("has more than 2 MiB"), "what was known of it stays known"
    assert scales.by_robot == {"walker": (2 << 20) + 1}
    weigh(1)
    weigh(-1)
    assert scales.exceeds(volume) == scales.exceeds("good", [volume]) == "", "a file may just have gone"
    weigh(-1)
    assert "the engine cannot tell how much is in there" in scales.exceeds(volume)
    assert "the engine cannot tell how much is in there" in scales.exceeds("good", [volume])
    weigh(1)
    assert scales.exceeds(volume) == "", "somebody has tidied up"


def test_an_engine_that_takes_its_time_is_asked_once_and_holds_nobody_up() -> None:
    engine, now = FakeEngine(), [0.0]
    engine.hangs = threading.Event()
    scales = Scales(engine, "ab", 2, lambda: now[0])  # type: ignore[arg-type]
    for _ in range(5):
        scales.begin()
        now[0] += 100.0
    engine.hangs.set()
    assert engine.asks == 1
    for thread in threading.enumerate():
        if thread.name == "docker-volumes":
            thread.join(30)
    assert scales.exceeds("full")
    engine.refuses = True
    scales.begin()
    for thread in threading.enumerate():
        if thread.name == "docker-volumes":
            thread.join(30)
    assert engine.asks == 2
    assert scales.exceeds("full"), "what was known stays known"


def test_an_engine_that_never_weighs_is_told_once_and_when_it_does_again(caplog: pytest.LogCaptureFixture) -> None:
    engine, now = FakeEngine(), [0.0]
    engine.refuses = True
    scales = Scales(engine, "ab", 2, lambda: now[0])  # type: ignore[arg-type]

    def weigh(times: int) -> None:
        for _ in range(times):
            now[0] += 100.0
            scales.begin()
            for thread in threading.enumerate():
                if thread.name == "docker-volumes":
                    thread.join(30)

    with caplog.at_level(logging.INFO):
        weigh(2)
        assert caplog.text == "", "somebody else may have asked just then"
        weigh(5)
        assert caplog.text.count("volumes are not weighed, so that data_mb (2) bounds nothing: no") == 1
        engine.refuses = False
        weigh(2)
        assert caplog.text.count("volumes are weighed again") == 1


def test_what_wrote_too_much_is_seen_so() -> None:
    options = DockerOptions()
    running = ContainerState("c", "i1", 1, "running", host_port=7, ready=True, volume="full")
    assert observation(running, options, exceeds="too much").exceeds == "too much"
    assert observation(ContainerState("c", "i1", 1, "running"), options, exceeds="too much").exceeds == "too much"
    assert observation(running, options).phase is Phase.RUNNING
    mounts = [
        {"Destination": "/run/skytether", "Name": "grant"},
        {"Destination": "/var/lib/skytether", "Name": "skytether-me-data-walker-toy"},
    ]
    described = {
        "Id": "c1",
        "Config": {"Labels": {"skytether.io/instance": "i1", "skytether.io/attempt": "3"}},
        "HostConfig": {"Memory": 0},
        "NetworkSettings": {},
        "State": {"Status": "running", "ExitCode": 0, "OOMKilled": False},
        "Mounts": mounts,
    }
    seen = parse(described)
    assert seen is not None
    assert seen.volume == "skytether-me-data-walker-toy"
