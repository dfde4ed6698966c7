"""How much one may have: robots, services, sites."""

from __future__ import annotations

import os
import threading
from pathlib import Path
from typing import Any

import pytest

from skytether.api.client import ApiError
from skytether.api.rest import InstanceCreate, Renew, State
from skytether.orchestrator.access.access import Principal
from skytether.orchestrator.access.quotas import Quotas
from skytether.orchestrator.config.settings import Quotas as Settings
from skytether.orchestrator.domain.errors import TooManyError
from skytether.orchestrator.runtimes.base import Observation, Phase
from skytether.orchestrator.runtimes.disk import remove_tree, size_of
from skytether.orchestrator.store.store import Store

ASK = InstanceCreate(robot="walker", service="toy", lease_s=60)


def refused(call: Any, *arguments: Any) -> tuple[int, str]:
    with pytest.raises(ApiError) as caught:
        call(*arguments)
    return caught.value.problem.status, str(caught.value)


@pytest.mark.parametrize(
    ("quota", "says"),
    [
        ({"robot_instances": 3}, "robot 'walker' would have 4 instances, and may have 3 (quotas.robot_instances)"),
        ({"robot_cpu": 0.3}, "robot 'walker' would have 0.4 cores, and may have 0.3 (quotas.robot_cpu)"),
        (
            {"robot_memory_mb": 400},
            "robot 'walker' would have 512 MiB of memory, and may have 400 (quotas.robot_memory_mb)",
        ),
        ({"service_instances": 3}, "service 'toy' would have 4 instances, and may have 3 (quotas.service_instances)"),
    ],
)
def test_what_a_robot_has_is_bounded_shown_and_counted(served_with: Any, quota: Any, says: str) -> None:
    served = served_with(quotas=Settings(**quota))
    served.site(cpu=100, memory_mb=100_000)
    robot = served.robot()
    made = [robot.create_instance(ASK) for _ in range(3)]
    assert refused(robot.create_instance, ASK) == (409, f"{says}: let one end first")
    if "service_instances" not in quota:
        assert served.operator.create_instance(ASK.model_copy(update={"robot": "other"})).robot == "other"
    use = next(one for one in served.operator.robots() if one.name == "walker").use
    assert (use.instances, use.cpu, use.memory_mb) == (3, 0.3, 384)
    metrics = served.operator.metrics()
    (key,) = quota
    assert f'skytether_quota_limit{{quota="{key}"}} {float(quota[key])}' in metrics
    assert f'skytether_quota_refusals_total{{quota="{key}"}}' in metrics
    assert 'skytether_robot_instances{robot="walker"} 3.0' in metrics
    robot.delete_instance(made[0].id)
    list(robot.watch(made[0].id, timeout=10))
    assert robot.create_instance(ASK).id


def test_requests_that_come_at_once_do_not_share_the_last_place(served_with: Any) -> None:
    served = served_with(quotas=Settings(robot_instances=4))
    served.site(cpu=100, memory_mb=100_000)
    robot = served.robot()
    made: list[str] = []

    def ask() -> None:
        try:
            made.append(robot.create_instance(ASK).id)
        except ApiError as error:
            assert "quotas.robot_instances" in str(error)  # noqa: PT017

    threads = [threading.Thread(target=ask) for _ in range(12)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(made) == len(robot.instances()) == 4


def test_moving_again_and_again_makes_no_more_than_a_robot_may_have(served_with: Any) -> None:
    served = served_with(quotas=Settings(robot_instances=3))
    for name in ("a", "b"):
        served.site(name, cpu=100, memory_mb=100_000)
    robot = served.robot()
    at = robot.wait_running(robot.create_instance(ASK).id)
    for _ in range(2):
        at = robot.wait_running(robot.migrate_instance(at.id).id)
    assert "quotas.robot_instances" in refused(robot.migrate_instance, at.id)[1]


def test_a_robots_lease_is_bounded_and_an_operators_is_not(served_with: Any) -> None:
    served = served_with(quotas=Settings(robot_lease_s=100))
    served.site()
    robot = served.robot()
    long = ASK.model_copy(update={"lease_s": 86_400})
    assert refused(robot.create_instance, long) == (
        422,
        "lease_s: is 86400 s, and a robot may have 100 s (quotas.robot_lease_s)",
    )
    made = robot.create_instance(ASK)
    renewed = robot.renew_instance(made.id, Renew(lease_s=86_400))  # what it has already is not lost over it
    assert 90 < (renewed.lease_expires_at - renewed.updated_at).total_seconds() < 110
    kept = served.operator.renew_instance(made.id, Renew(lease_s=86_400))
    assert (kept.lease_expires_at - kept.updated_at).total_seconds() > 86_000


def test_a_site_takes_so_many_and_the_others_wait(served_with: Any) -> None:
    served = served_with(quotas=Settings(site_instances=2))
    served.site(cpu=100, memory_mb=100_000)
    operator = served.operator
    made = [operator.create_instance(ASK.model_copy(update={"robot": f"r{n}"})) for n in range(3)]
    for one in made[:2]:
        operator.wait_running(one.id)
    with pytest.raises(Exception, match="2 instances are there, and 2 may be"):
        operator.wait_running(made[2].id, timeout=1)
    operator.delete_instance(made[0].id)
    assert operator.wait_running(made[2].id).state is State.RUNNING


def test_streams_are_bounded_by_robot_and_in_all_and_given_back(store: Store) -> None:
    quotas = Quotas(store, Settings(robot_streams=2, streams=4, log_streams=1))
    robot, other, operator = Principal("walker"), Principal("other"), Principal(None)
    with quotas.stream(robot, log=True), quotas.stream(robot):
        with pytest.raises(TooManyError, match=r"quotas\.robot_streams"), quotas.stream(robot):
            pass
        with pytest.raises(TooManyError, match=r"quotas\.log_streams"), quotas.stream(other, log=True):
            pass
        with quotas.stream(operator), quotas.stream(operator):
            assert quotas.open_streams == 4
            with pytest.raises(TooManyError, match=r"quotas\.streams"), quotas.stream(operator):
                pass
    assert quotas.open_streams == 0
    assert dict(quotas.refused) == {"robot_streams": 1, "log_streams": 1, "streams": 1}
    with quotas.stream(robot, log=True), quotas.stream(robot):
        pass


def test_watchers_that_leave_make_room(served_with: Any) -> None:
    served = served_with(quotas=Settings(robot_streams=2))
    served.site()
    robot = served.robot()
    made = robot.create_instance(ASK)
    for _ in range(3):
        assert list(robot.watch(made.id, timeout=0.5))
    watching = [robot.watch(made.id), robot.watch(made.id)]
    for one in watching:
        next(one)
    assert refused(lambda: next(robot.watch(made.id)))[0] == 429
    robot.delete_instance(made.id)
    for one in watching:
        assert list(one)[-1].state.final
    assert list(robot.watch(made.id))[-1].state.final


def test_what_wrote_too_much_is_ended_for_good_with_the_reason(served: Any) -> None:
    fake = served.site()
    robot = served.robot()
    made = robot.wait_running(robot.create_instance(ASK).id)
    run = fake.world[made.id]
    look = fake.observe

    def full() -> Any:
        seen = look()
        if run.launch.instance not in seen or seen[made.id].phase is not Phase.RUNNING:
            return seen
        one = seen[made.id]
        return {made.id: Observation(one.attempt, one.phase, one.host, one.port, exceeds="has written too much")}

    fake.observe = full
    (*_, last) = robot.watch(made.id, timeout=20)
    assert last.state is State.FAILED
    assert last.reason.startswith("the service has written too much")


def too_deep(folder: str) -> None:
    """Folders that have no path: the system takes 4,096 characters; and more than Python calls of one in another."""
    at = os.open(folder, os.O_PATH)
    for _ in range(1_500):
        os.mkdir("d" * 9, dir_fd=at)
        below = os.open("d" * 9, os.O_PATH, dir_fd=at)
        os.close(at)
        at = below
    os.close(at)


def test_how_much_is_in_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a/b").mkdir(parents=True)
    (tmp_path / "a/b/large").write_bytes(bytes(1 << 20))
    (tmp_path / "a/link").symlink_to("/usr")
    assert (1 << 20) <= (size_of(str(tmp_path), 1 << 30) or 0) < (1 << 20) + 100_000
    assert (size_of(str(tmp_path), 1000) or 0) > 1000
    assert size_of(str(tmp_path / "none"), 1) == 0
    too_deep(str(tmp_path / "a"))
    assert size_of(str(tmp_path), 1 << 30) is None
    remove_tree(str(tmp_path / "a"))
    assert not (tmp_path / "a").exists()
    assert size_of(str(tmp_path), 1 << 30) == 0
    (tmp_path / "a/b").mkdir(parents=True)
    monkeypatch.setattr("skytether.orchestrator.runtimes.disk.MOST_FILES", 1)
    assert size_of(str(tmp_path), 1 << 30) is None
