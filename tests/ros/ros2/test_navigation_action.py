"""The service navigation as Nav2: a real Zenoh router, a client of the action played by test code."""

import threading
from pathlib import Path

import pytest
import yaml
from harness_port import carried
from ros2_graph import shared_router, stage

import skytether_services.navigation as package
from skytether.api.manifest import Manifest
from skytether.messages import (
    UUID,
    CancelGoalRequest,
    CancelGoalResponse,
    GoalInfo,
    GoalStatusArray,
    Header,
    NavigateToPose,
    NavigateToPoseGoal,
    Point,
    Pose,
    PoseStamped,
    decode,
    encode,
    hash_of,
)
from skytether.robot.graphs.ros2.robot import Ros2Robot, Ros2RobotConfig
from skytether.testing.service import Harness
from skytether_services.navigation.service import Navigation

__all__ = ["shared_router", "stage"]
pytestmark = pytest.mark.slow

NAME, KIND = "/navigation/navigate_to_pose/_action", NavigateToPose.name
MADE = NavigateToPose.wrappers


def dds(name):
    package_name, kind, short = name.split("/")
    return f"{package_name}::{kind}::dds_::{short}_"


class Client:
    """As rclpy's: three calls, each answered within the patience of the played node."""

    def __init__(self, stage, rmw):
        calls = {"send_goal": f"{KIND}_SendGoal", "get_result": f"{KIND}_GetResult"}
        calls["cancel_goal"] = "action_msgs/srv/CancelGoal"
        for part in calls:
            stage.until(lambda part=part: rmw.sees("SS", f"{NAME}/{part}"), f"no {part} in the graph")
        self._calls = {p: rmw.client(f"{NAME}/{p}", dds(k), hash_of(k, "cdr")) for p, k in calls.items()}
        self._sequence = 0

    def ask(self, part, request, response):
        self._sequence += 1
        return decode(response, self._calls[part](encode(request), self._sequence)[0])

    def send(self, number, goal):
        request = MADE["SendGoal_Request"](UUID([number] * 16), goal)
        return self.ask("send_goal", request, MADE["SendGoal_Response"])

    def cancel(self, number):
        return self.ask("cancel_goal", CancelGoalRequest(GoalInfo(UUID([number] * 16))), CancelGoalResponse)

    def result(self, number):
        return self.ask("get_result", MADE["GetResult_Request"](UUID([number] * 16)), MADE["GetResult_Response"])


@pytest.fixture
def harness(tmp_path):
    """Navigation, stepping by itself."""
    harness = Harness(Navigation, {"controller": "dwa"}, data_dir=tmp_path)
    end = threading.Event()

    def step():
        while not end.wait(0.02):
            harness.step()

    thread = threading.Thread(target=step)
    yield harness, thread
    end.set()
    thread.join()


def test_goals_are_accepted_rejected_called_off_and_replaced(stage, harness):
    service, steps = harness
    manifest = yaml.safe_load(Path(package.__file__).with_name("service.yaml").read_text())
    specs = Manifest.model_validate(manifest).spec.topics
    rmw = stage.rmw("client")
    status_type = GoalStatusArray.TYPE
    status = rmw.subscribe(f"{NAME}/status", dds(status_type), hash_of(status_type, "cdr"), depth=1)
    robot = Ros2Robot(Ros2RobotConfig("bot", "navigation"), stage.ours())

    def told():
        return [s.status for s in decode(GoalStatusArray, status.payloads[-1]).status_list] if status.payloads else None

    with carried(service, specs, lambda: robot.open(specs, "cmd_vel")):
        steps.start()
        client = Client(stage, rmw)
        assert not rmw.sees("MP", "/navigation/move_base/status")
        there = PoseStamped(Header(frame_id="map"), Pose(Point(1.0, 2.0)))
        assert client.send(1, NavigateToPoseGoal(there)).accepted
        stage.until(lambda: told() == [2], "it is not executing")
        assert not client.send(2, NavigateToPoseGoal(PoseStamped(Header(frame_id="odom")))).accepted
        assert client.cancel(9).return_code == 2
        canceled = client.cancel(1)
        assert (canceled.return_code, len(canceled.goals_canceling)) == (0, 1)
        assert client.result(1).status == 5
        assert client.send(3, NavigateToPoseGoal(there)).accepted
        assert client.send(4, NavigateToPoseGoal(there)).accepted
        replaced = client.result(3)
        assert (replaced.status, replaced.result.error_msg) == (6, "A newer goal has come.")
        stage.until(lambda: told() == [5, 6, 2], "the status is another")
        assert client.result(7).status == 0
    robot.close()
