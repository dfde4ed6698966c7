"""Sites that are drained, take instances again, and are removed: what is there is moved, robots handed over first."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from node_scene import until

from skytether.api.client import ApiError, Client
from skytether.api.rest import InstanceCreate, State


def ask(client: Client, **more: Any) -> str:
    made = client.create_instance(InstanceCreate(robot="walker", service="toy", lease_s=1000, **more))
    client.wait_running(made.id)
    return made.id


def successor(client: Client, instance: str) -> str:
    return str(until(lambda: client.renew_instance(instance).successor))


@pytest.fixture
def robot(served: Any) -> Client:
    client: Client = served.robot()
    return client


def test_what_is_at_a_site_that_is_drained_is_moved_and_runs_on_until_its_robot_has_changed(
    served: Any, robot: Client
) -> None:
    served.site("lab")
    instance = ask(robot)
    served.site("other")
    site = served.operator.drain_site("lab")
    assert site.evacuating
    later = robot.wait_running(successor(robot, instance))
    assert later.placement is not None
    assert later.placement.site == "other"
    before = robot.get_instance(instance)
    assert (before.state, before.restarts) == (State.RUNNING, 0)
    assert before.reason == "site lab is being drained: its robot is handed over"
    robot.delete_instance(instance)  # it has changed
    until(lambda: served.operator.get_site("lab").instances == 0)
    assert served.operator.get_site("lab").evacuating  # and is there still


def test_a_site_that_is_drained_takes_nothing_until_it_is_to_again(served: Any, robot: Client) -> None:
    served.site("lab")
    served.operator.drain_site("lab")
    with pytest.raises(ApiError, match="no site can run"):
        robot.create_instance(InstanceCreate(robot="walker", service="toy"))
    assert not served.operator.resume_site("lab").evacuating
    ask(robot)


def test_what_nothing_else_takes_stays_and_says_why(served: Any, robot: Client) -> None:
    served.site("lab")
    instance = ask(robot)
    served.operator.drain_site("lab")
    until(lambda: "and nothing else takes it" in robot.get_instance(instance).reason)
    assert robot.get_instance(instance).state is State.RUNNING
    served.operator.resume_site("lab")
    until(lambda: robot.get_instance(instance).reason == "")


def test_another_orchestrator_and_the_next_start_know_of_it(served: Any) -> None:
    served.site("lab")
    served.operator.drain_site("lab")
    site = served.core.sites.get("lab")
    site.evacuating = False
    served.core.sites.refresh()
    assert site.evacuating
    served.core.store.evacuate_site("lab", False)
    served.core.sites.refresh()
    assert not site.evacuating


def test_what_is_to_be_deleted_with_its_last_instance_is_not_taken_back(served: Any, robot: Client) -> None:
    served.site("lab")
    ask(robot)
    assert not served.operator.delete_site("lab", drain=True)
    with pytest.raises(ApiError, match="that cannot be taken back"):
        served.operator.resume_site("lab")


def test_a_site_whose_machine_is_gone_for_good_is_deleted_and_its_robots_ask_again(served: Any, robot: Client) -> None:
    runtime = served.site("lab")
    instance = ask(robot)
    runtime.silent = True
    with pytest.raises(ApiError, match="has 1 instances"):
        served.operator.delete_site("lab")
    assert served.operator.delete_site("lab", force=True)
    ended = until(lambda: (found := robot.get_instance(instance)).state.final and found)
    assert (ended.state, ended.reason) == (State.FAILED, "site 'lab' was deleted: ask again")
    served.site("lab")
    ask(robot)


@pytest.mark.parametrize("ask_for", ["drain_site", "resume_site"])
def test_a_site_that_there_is_not_is_told(served: Any, ask_for: str) -> None:
    asked: Callable[[str], Any] = getattr(served.operator, ask_for)
    with pytest.raises(ApiError, match="there is no site 'nowhere'"):
        asked("nowhere")


def test_without_a_port_for_nodes_nobody_is_invited(served: Any) -> None:
    from skytether.api.rest import Invite

    with pytest.raises(ApiError, match=r"set nodes\.port \(SKYTETHER_NODES_PORT=8603\)"):
        served.operator.invite(Invite(name="ward"))
