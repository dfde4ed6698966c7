"""Data on disk in sum: of a robot at all sites, of all robots at a site."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest

from skytether.api.client import ApiError
from skytether.api.rest import InstanceCreate, RobotCreate, State
from skytether.orchestrator.access.disk_usage import DiskUsage
from skytether.orchestrator.config.settings import Quotas
from skytether.orchestrator.runtimes.docker.objects import stored_by_robot
from skytether.orchestrator.runtimes.process import ProcessOptions, ProcessRuntime
from skytether.testing.runtimes import FakeRuntime

MB = 1 << 20
ASK = InstanceCreate(robot="walker", service="toy", lease_s=60)


def test_a_robot_is_bounded_over_all_sites_and_the_first_byte_beyond_is_one() -> None:
    weighed = {"edge": {"walker": 6 * MB, "runner": MB}, "cloud": {"walker": 4 * MB}}
    stored = DiskUsage(lambda: weighed, Quotas(robot_data_mb=10, site_data_mb=100))
    assert stored.by_robot() == {"walker": 10 * MB, "runner": MB}
    assert stored.by_site() == {"edge": 7 * MB, "cloud": 4 * MB}
    assert stored.too_much("edge") == stored.too_much("none") == stored.full() == {}
    weighed["cloud"]["walker"] += 1
    assert "robot 'walker', 11 MiB of data, and may have 10 (quotas.robot_data_mb)" in stored.too_much("edge")["walker"]
    assert stored.too_much("edge").keys() == stored.too_much("none").keys() == {"walker"}


def test_at_a_full_site_those_end_who_have_more_than_their_share() -> None:
    weighed = {"edge": {"walker": 7 * MB, "runner": 4 * MB, "sitter": MB}}
    stored = DiskUsage(lambda: weighed, Quotas(site_data_mb=12))
    assert stored.full() == stored.too_much("edge") == {}
    weighed["edge"]["sitter"] += MB
    assert stored.full() == {"edge": "13 MiB of data are there, and 12 may be (quotas.site_data_mb)"}
    assert "robot 'walker' has 7 MiB, more than its share of 12" in stored.too_much("edge")["walker"]
    assert stored.too_much("edge").keys() == {"walker"}


def test_of_robots_that_had_nothing_there_the_word_of_a_machine_that_joined_counts_nowhere_else() -> None:
    """It says of a robot that never was there that it has written too much: wherever that ran, it was ended."""
    weighed = {"ours": {"walker": 6 * MB}, "theirs": {"walker": 1000 * MB, "runner": 11 * MB, "made-up": MB}}
    stored = DiskUsage(
        lambda: weighed,
        Quotas(robot_data_mb=10, site_data_mb=10_000),
        lambda site: frozenset({"runner"}) if site == "theirs" else None,
    )
    assert stored.by_robot() == {"walker": 6 * MB, "runner": 11 * MB}
    assert stored.of("walker") == 6 * MB
    assert stored.too_much("ours").keys() == {"runner"}
    assert stored.by_site()["theirs"] == 1012 * MB, "it is its own disk"


def test_however_many_robots_there_are_sites_are_asked_once() -> None:
    """In each pass they were asked twice for each robot, and a Docker site went through all volumes each time."""
    asked = []

    def weighed() -> dict[str, dict[str, int]]:
        asked.append(1)
        return {site: {f"r{n}": 3 * MB for n in range(100)} for site in ("edge", "cloud", "fog")}

    stored = DiskUsage(weighed, Quotas(robot_data_mb=8, site_data_mb=200))
    assert (len(stored.too_much("edge")), len(asked)) == (100, 1)
    assert (len(stored.full()), len(asked)) == (3, 2)


def test_robots_are_listed_by_one_look(served_with: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    served = served_with()
    for n in range(5):
        served.operator.create_robot(RobotCreate(name=f"r{n}"))
    looks = []
    monkeypatch.setattr(DiskUsage, "by_robot", lambda _: looks.append(1) or {"r3": MB})
    monkeypatch.setattr(DiskUsage, "of", None)
    assert {one.name: one.use.data_mb for one in served.operator.robots()}["r3"] == 1
    assert len(looks) == 1


def test_volumes_are_their_robots_whatever_hyphens_names_have() -> None:
    sizes = {
        "skytether-ab-data-walker-recorder": 1,
        "skytether-ab-data-walker-1.recorder": 2,
        "skytether-ab-data-walker.virtual-trail": 4,
        "skytether-cd-data-walker-recorder": 8,
        "skytether-ab-own-i1": 16,
        "another": 32,
    }
    assert stored_by_robot("ab", sizes) == {"walker": 5, "walker-1": 2}


def test_who_has_too_much_gets_nothing_started_and_ends_and_it_is_shown(
    served_with: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    stored: dict[str, int] = {"walker": 3 * MB, "other": MB}
    monkeypatch.setattr(FakeRuntime, "stored", lambda _: stored)
    served = served_with(quotas=Quotas(robot_data_mb=3))
    served.site()
    robot = served.robot()
    runs = robot.create_instance(ASK).id
    robot.wait_running(runs)
    (shown,) = [one for one in served.operator.robots() if one.name == "walker"]
    assert (shown.use.data_mb, shown.quota.data_mb, shown.use.streams, shown.quota.streams) == (3, 3, 0, 32)
    metrics = served.operator.metrics()
    assert 'skytether_robot_data_bytes{robot="walker"} 3' in metrics
    assert "skytether_site_data_bytes" in metrics
    assert 'skytether_robot_open_streams{robot="walker"} 0' in metrics
    stored["walker"] += 1
    with pytest.raises(ApiError, match=r"would have 4 MiB of data, and may have 3 \(quotas.robot_data_mb\): delete"):
        robot.create_instance(ASK)
    end = time.monotonic() + 30
    while not (ended := robot.get_instance(runs)).state.final and time.monotonic() < end:
        time.sleep(0.05)
    assert (ended.state, "quotas.robot_data_mb" in ended.reason) == (State.FAILED, True)


def test_a_full_site_gets_no_more(served_with: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    stored = {"other": 3 * MB}
    monkeypatch.setattr(FakeRuntime, "stored", lambda _: stored)
    served = served_with(quotas=Quotas(site_data_mb=2))
    served.site()
    robot = served.robot()
    waits = robot.create_instance(ASK).id
    end = time.monotonic() + 30
    while "site_data_mb" not in (found := robot.get_instance(waits)).reason and time.monotonic() < end:
        time.sleep(0.05)
    assert (found.state, "quotas.site_data_mb" in found.reason) == (State.PENDING, True)
    stored["other"] = MB
    robot.wait_running(waits)


def test_a_process_site_weighs_robots_of_which_nothing_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("skytether.orchestrator.runtimes.process.WEIGH_S", 0.0)
    for robot, size in (("walker", 100_000), ("runner", 300_000)):
        folder = tmp_path / "data" / robot / "recorder" / "i1"
        folder.mkdir(parents=True)
        (folder / "bag").write_bytes(bytes(size))
    (tmp_path / "data" / "lost+found").mkdir()  # of a file system that is mounted there; not to be read by us
    (tmp_path / "data" / "notes").write_text("of somebody")
    runtime = ProcessRuntime("lab", tmp_path, ProcessOptions())
    assert runtime.stored() == {}
    for _ in range(5):
        runtime.tidy()
    found = runtime.stored()
    assert found.keys() == {"walker", "runner"}
    assert 100_000 <= found["walker"] < 300_000 <= found["runner"]
    runtime.close()
