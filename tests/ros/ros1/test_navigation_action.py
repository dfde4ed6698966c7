"""The service navigation as move_base: a real actionlib client, and a simulated building in made-up time."""

import re
import subprocess
import time
from pathlib import Path

import pytest
import yaml
from harness_port import carried
from ros1_graph import wait_for

import skytether_services.navigation as package
from skytether.api.manifest import Manifest
from skytether.lab.world.plan import building
from skytether.robot.graphs.ros1.robot import Ros1Robot, Ros1RobotConfig
from skytether.ros.permissions import Allowed
from skytether.ros.ros1.node import Node
from skytether.testing.drive import Drive
from skytether_services.navigation.service import Navigation

pytestmark = [pytest.mark.ros1, pytest.mark.slow]

PAGE = Path(__file__).parents[3] / "docs" / "navigation.md"
PATIENCE_S = 240
MORE = """
def go(x):
    goal.target_pose.pose.position.x = x
    client.send_goal(goal)

def state():
    return GoalStatus.to_string(client.get_state())

go(4.0)
while client.get_state() != GoalStatus.ACTIVE:
    rospy.sleep(0.05)
client.cancel_goal()
client.wait_for_result()
print("called off:", state(), "|", client.get_goal_status_text())

first = actionlib.SimpleActionClient("/move_base", MoveBaseAction)
first.wait_for_server()
first.send_goal(goal)
while first.get_state() != GoalStatus.ACTIVE:
    rospy.sleep(0.05)
go(1.4)
first.wait_for_result()
print("gave way:", GoalStatus.to_string(first.get_state()), "|", first.get_goal_status_text())
client.wait_for_result()
print("instead:", state())

go(-50.0)
client.wait_for_result()
print("too far:", state(), "|", client.get_goal_status_text())

goal.target_pose.header.frame_id = "odom"
go(1.4)
client.wait_for_result()
print("bad:", state(), "|", client.get_goal_status_text())
"""


def client_of_the_page() -> str:
    found = [
        code for code in re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL) if "import actionlib" in code
    ]
    assert len(found) == 1
    return found[0]


def test_a_move_base_client_reaches_calls_off_and_replaces_goals(graph, tmp_path):
    """And the topic of RViz's 2D Nav Goal, all by the names that their users know."""
    manifest = yaml.safe_load(Path(package.__file__).with_name("service.yaml").read_text())
    specs = Manifest.model_validate(manifest).spec.topics
    config = Ros1RobotConfig(
        "walker",
        "navigation",
        namespace="/",
        remap={"move_base": "/move_base", "goal": "/move_base_simple/goal"},
        allowed=Allowed(publish=["/move_base"]),
    )
    drive = Drive(Navigation, tmp_path, {"controller": "dwa"}, building(), encoding="ros1")
    with Node("skytether", graph.uri, look_s=0.2) as node:
        robot = Ros1Robot(config, node)
        with carried(drive.harness, specs, lambda: robot.open(specs, "cmd_vel")):
            drive.run(0.5)
            client = graph.python(client_of_the_page() + MORE, stdout=subprocess.PIPE)
            deadline = time.monotonic() + PATIENCE_S
            while client.poll() is None:
                assert time.monotonic() < deadline, drive.status
                drive.run(0.1)
                time.sleep(0.01)
            names = {name for name, _ in graph.call("getPublishedTopics", "")}
            assert not [name for name in names if "navigate_" in name]
            assert client.stdout is not None
            said = client.stdout.read().decode().splitlines()
            graph.start(
                "rostopic", "pub", "-1", "/move_base_simple/goal", "geometry_msgs/PoseStamped",
                "{header: {frame_id: map}, pose: {position: {x: 2.0, y: 1.1}, orientation: {w: 1.0}}}",
            )  # fmt: skip
            wait_for(lambda: drive.run(0.1) or drive.status["target"] == [2.0, 1.1, 0.0], "RViz's goal", PATIENCE_S)
        robot.close()
    *way, reached, called_off, gave_way, instead, too_far, bad = said
    assert way
    assert all(re.fullmatch(r"the robot is at x = \d\.\d\d m", line) for line in way), way
    assert reached == "SUCCEEDED: The last goal was reached."
    assert called_off == "called off: PREEMPTED | The goal was called off."
    assert gave_way == "gave way: PREEMPTED | A newer goal has come."
    assert instead == "instead: SUCCEEDED"
    assert too_far.startswith("too far: ABORTED | Goal 1 at (-50.00, 1.10) is not on the map")
    assert bad == "bad: REJECTED | A goal is in the frame 'odom'; give it in 'map'."
    assert not drive.world.contacts
