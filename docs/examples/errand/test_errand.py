"""Actions in tests: the robot's client is `ActionClient`."""

from pathlib import Path

import yaml

from errand.service import Errand
from skytether.api.manifest import Manifest
from skytether.messages import Header, MoveBaseGoal, Odometry, Point, Pose, PoseStamped, PoseWithCovariance
from skytether.testing.actions import ActionClient
from skytether.testing.service import Harness


def goal(x, frame="odom"):
    return MoveBaseGoal(PoseStamped(Header(frame_id=frame), Pose(Point(x))))


def test_a_goal_is_driven_to_and_another_called_off():
    harness = Harness(Errand, encoding="ros1")
    client = ActionClient(harness, "move_base")
    first = client.send(goal(1.0))
    harness.send("odom", Odometry(pose=PoseWithCovariance(Pose(Point(0.5)))))
    harness.step()
    assert client.state(first) == "active"
    assert harness.newest("cmd_vel").linear.x == 0.2
    assert client.feedback(first)[0].base_position.pose.position.x == 0.5
    harness.send("odom", Odometry(pose=PoseWithCovariance(Pose(Point(1.0)))))
    harness.step()
    assert client.end(first)[0] == "succeeded"
    second, third = client.send(goal(2.0)), client.send(goal(3.0))
    harness.step()
    assert client.end(second)[:2] == ("preempted", "a newer goal has come")
    client.cancel(third)
    harness.step()
    assert client.end(third)[:2] == ("preempted", "as you wish")
    assert harness.newest("cmd_vel").linear.x == 0.0


def test_a_goal_in_another_frame_is_rejected():
    harness = Harness(Errand, encoding="ros1")
    client = ActionClient(harness, "move_base")
    bad = client.send(goal(1.0, "map"))
    harness.step()
    assert client.end(bad)[:2] == ("rejected", "a goal is wanted in the frame odom")


def test_the_manifest_says_what_the_class_does():
    manifest = Manifest.model_validate(yaml.safe_load(Path(__file__).with_name("service.yaml").read_text()))
    rows = {(t.name, t.kind, t.type, t.direction) for t in manifest.spec.topics}
    assert rows == {(d.topic, d.kind, d.type_name, d.direction.value) for d in Errand.declared}
