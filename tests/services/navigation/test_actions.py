"""Navigation by the actions of move_base and Nav2."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import skytether_services.navigation as package
from skytether.api.manifest import Manifest
from skytether.lab.world.plan import building
from skytether.messages import (
    Header,
    Message,
    MoveBaseGoal,
    NavigateThroughPosesFeedback,
    NavigateThroughPosesGoal,
    NavigateToPoseFeedback,
    NavigateToPoseGoal,
    NavigateToPoseResult,
    Point,
    Pose,
    PoseStamped,
    TriggerRequest,
    Twist,
)
from skytether.robot.session.topic_table import robot_table, spoken
from skytether.testing.actions import ActionClient
from skytether.testing.drive import Drive
from skytether.testing.service import Harness
from skytether_services.navigation.action_goals import way_left
from skytether_services.navigation.service import Navigation
from skytether_services.planar.geometry import Pose as At

DWA = {"controller": "dwa"}
"""Its constructor compiles nothing."""
ACTIONS = [("ros1", "move_base"), ("cdr", "navigate_to_pose"), ("cdr", "navigate_through_poses")]


def served(folder: Path, encoding: str, **params: object) -> Harness[Navigation]:
    return Harness(Navigation, {**DWA, **params}, data_dir=folder, encoding=encoding)


def at(x: float, y: float, frame: str = "map") -> PoseStamped:
    return PoseStamped(Header(frame_id=frame), Pose(Point(x, y)))


def goal(name: str, *poses: PoseStamped) -> Message:
    kinds: dict[str, Any] = {"move_base": MoveBaseGoal, "navigate_to_pose": NavigateToPoseGoal}
    return NavigateThroughPosesGoal(poses) if name == "navigate_through_poses" else kinds[name](poses[0])


def told(harness: Harness[Navigation]) -> dict[str, Any]:
    harness.step()
    return dict(json.loads(harness.newest("status").data))


@pytest.mark.parametrize(("encoding", "name"), ACTIONS)
def test_a_goal_is_accepted_and_called_off(tmp_path: Path, encoding: str, name: str) -> None:
    harness = served(tmp_path, encoding)
    client = ActionClient(harness, name)
    sent = client.send(goal(name, at(1.0, 2.0)))
    assert told(harness)["target"] == [1.0, 2.0, 0.0]
    assert client.state(sent) == "active"
    client.cancel(sent)
    assert told(harness)["state"] == "canceled"
    assert client.state(sent) == "preempted"
    assert harness.newest("cmd_vel") == Twist()


@pytest.mark.parametrize(("encoding", "name"), ACTIONS)
@pytest.mark.parametrize("wrong", [at(1.0, 0.0, "odom"), at(math.nan, 0.0)])
def test_a_bad_goal_is_rejected_and_the_present_one_goes_on(
    tmp_path: Path, encoding: str, name: str, wrong: PoseStamped
) -> None:
    harness = served(tmp_path, encoding)
    client = ActionClient(harness, name)
    first = client.send(goal(name, at(1.0, 2.0)))
    harness.step()
    bad = client.send(goal(name, wrong))
    assert told(harness)["target"] == [1.0, 2.0, 0.0]
    end = client.end(bad)
    assert end is not None
    assert end[0] == "rejected"
    assert client.state(first) == "active"
    assert [report.code for report in harness.service.reports.recent] == ["bad_goal"]


def test_lists_that_are_none_and_behaviour_trees_of_nav2_are_rejected(tmp_path: Path) -> None:
    harness = served(tmp_path, "cdr")
    through, to = ActionClient(harness, "navigate_through_poses"), ActionClient(harness, "navigate_to_pose")
    empty = through.send(NavigateThroughPosesGoal())
    tree = to.send(NavigateToPoseGoal(at(1.0, 2.0), "my_tree.xml"))
    harness.step()
    assert (through.is_accepted(empty), to.is_accepted(tree)) == (False, False)
    assert [report.code for report in harness.service.reports.recent] == ["bad_goal", "no_goals"]


@pytest.mark.parametrize(
    ("encoding", "name", "end"), [("ros1", "move_base", "preempted"), ("cdr", "navigate_to_pose", "aborted")]
)
@pytest.mark.parametrize("newer", ["the same action", "a topic", "a bad topic"])
def test_a_newer_goal_of_anybody_takes_its_place(
    tmp_path: Path, encoding: str, name: str, end: str, newer: str
) -> None:
    harness = served(tmp_path, encoding)
    client = ActionClient(harness, name)
    first = client.send(goal(name, at(1.0, 2.0)))
    harness.step()
    if newer == "the same action":
        second = client.send(goal(name, at(3.0, 4.0)))
    else:
        harness.send("goal", at(3.0, 4.0, "map" if newer == "a topic" else "odom"))
    after = told(harness)
    assert client.state(first) == end
    if newer == "the same action":
        assert client.state(second) == "active"
    assert after["state"] == ("failed" if newer == "a bad topic" else "standing")
    assert after["target"] == ([1.0, 2.0, 0.0] if newer == "a bad topic" else [3.0, 4.0, 0.0])


def test_a_goal_of_one_action_gives_way_to_one_of_another(tmp_path: Path) -> None:
    harness = served(tmp_path, "cdr")
    to, through = ActionClient(harness, "navigate_to_pose"), ActionClient(harness, "navigate_through_poses")
    first = to.send(goal("navigate_to_pose", at(1.0, 2.0)))
    harness.step()
    second = through.send(goal("navigate_through_poses", at(3.0, 4.0), at(5.0, 6.0)))
    assert told(harness)["goals"] == 2
    assert (to.state(first), through.state(second)) == ("aborted", "active")


def test_the_call_cancel_ends_a_client_s_goal_too(tmp_path: Path) -> None:
    harness = served(tmp_path, "ros1")
    client = ActionClient(harness, "move_base")
    sent = client.send(goal("move_base", at(1.0, 2.0)))
    harness.step()
    assert harness.call("cancel", TriggerRequest()).success
    harness.step()
    assert client.state(sent) == "preempted"


def test_no_goals_while_a_map_is_built(tmp_path: Path) -> None:
    harness = served(tmp_path, "ros1", mode="map")
    client = ActionClient(harness, "move_base")
    sent = client.send(goal("move_base", at(1.0, 2.0)))
    harness.step()
    end = client.end(sent)
    assert end is not None
    assert end[:2] == ("rejected", "A map is being built: the robot takes no goals.")
    harness.stop()


def test_the_way_that_is_left_goes_along_the_path_and_then_straight() -> None:
    goals = [At(2.0, 0.0, 0.0), At(5.0, 0.0, 0.0), At(5.0, 4.0, 0.0)]
    path = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [5.0, 0.0, 0.0]])
    assert way_left(5.0, path, At(0.0, 0.0, 0.0), goals) == pytest.approx(5.0 + 4.0)
    assert way_left(2.0, path[:2], At(0.0, 0.0, 0.0), goals) == pytest.approx(2.0 + 3.0 + 4.0)
    assert way_left(math.nan, path[:0], At(0.0, 0.0, 0.0), goals) == pytest.approx(2.0 + 3.0 + 4.0)


def followed(drive: Drive, client: ActionClient, sent: str) -> list[Any]:
    """Drive to the goal's end, and give all feedback: of what is published, a drive keeps the newest alone."""
    fed: list[Any] = []

    def has_ended() -> bool:
        fed.extend(told for told in client.feedback(sent) if not fed or told is not fed[-1])
        return client.end(sent) is not None

    assert drive.run(40.0, has_ended), drive.status
    return fed


@pytest.mark.slow  # in the simulated building
def test_goals_are_reached_and_what_cannot_be_is_aborted_with_the_reason(tmp_path: Path) -> None:
    start = building().starts[0]
    drive = Drive(Navigation, tmp_path, DWA, building())
    to, through = (ActionClient(drive.harness, f"navigate_{part}") for part in ("to_pose", "through_poses"))
    drive.run(0.5)
    sent = to.send(goal("navigate_to_pose", at(start.x + 1.0, start.y)))
    fed: list[NavigateToPoseFeedback] = followed(drive, to, sent)
    assert to.end(sent) == ("succeeded", "", NavigateToPoseResult())
    assert len(fed) >= 5
    assert fed[0].distance_remaining == pytest.approx(1.0, abs=0.4)
    assert fed[-1].distance_remaining < 0.4
    assert fed[-1].current_pose.pose.position.x == pytest.approx(start.x + 1.0, abs=0.4)
    assert fed[-1].navigation_time.seconds() == pytest.approx(0.2 * (len(fed) - 1), abs=0.3)
    on = through.send(goal("navigate_through_poses", at(start.x + 2.0, start.y), at(start.x + 3.0, start.y)))
    counted: list[NavigateThroughPosesFeedback] = followed(drive, through, on)
    assert through.state(on) == "succeeded"
    assert [counted[0].number_of_poses_remaining, counted[-1].number_of_poses_remaining] == [2, 1]
    off = to.send(goal("navigate_to_pose", at(-50.0, 0.0)))
    assert drive.run(2.0, lambda: to.end(off) is not None)
    end = to.end(off)
    assert end is not None
    assert (end[0], end[2].error_code) == ("aborted", 204)
    assert "is not on the map" in end[2].error_msg
    assert not drive.world.contacts


def test_each_robot_has_the_actions_of_its_own_generation_and_one_without_ros_has_none() -> None:
    text = Path(package.__file__).with_name("service.yaml").read_text()
    specs = Manifest.model_validate(yaml.safe_load(text)).spec.topics

    def actions(kind: Any) -> set[str]:
        table = robot_table(spoken(specs, kind), {})
        return {topic.name.split("/")[0] for topic in table if "/" in topic.name}

    calls = {"cancel", "pause", "clear_costmaps", "save_map"}
    assert actions("action") - calls == {"move_base"}
    assert actions("ros2_action") - calls == {"navigate_to_pose", "navigate_through_poses"}
    assert actions(None) - calls == set()
