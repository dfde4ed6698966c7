from pathlib import Path

import pytest
import yaml

import skytether_services.virtual_trail as package
from skytether.api.manifest import Manifest
from skytether.lab.walker import WalkerParams
from skytether.messages import (
    Header,
    JointState,
    Odometry,
    Point,
    Pose,
    PoseWithCovariance,
    Time,
    Twist,
    Vector3,
    Wrench,
    WrenchStamped,
    quaternion_from_yaw,
)
from skytether.service import ConfigError, params_schema
from skytether.testing.service import Harness
from skytether_services.virtual_trail.params import Params
from skytether_services.virtual_trail.service import VirtualTrail, pose_of, wheels_of

STRAIGHT = {"trail": [{"length": 5.0}]}


@pytest.fixture(scope="module")
def manifest() -> Manifest:
    text = Path(package.__file__).with_name("service.yaml").read_text()
    return Manifest.model_validate(yaml.safe_load(text))


def test_manifest_s_schema_is_the_dataclass_s(manifest: Manifest) -> None:
    assert manifest.spec.params == params_schema(VirtualTrail)


def test_manifest_s_topics_are_the_class_s(manifest: Manifest) -> None:
    listed = {(t.name, t.type, t.direction) for t in manifest.spec.topics}
    assert listed == {(d.topic, d.type_name, str(d.direction)) for d in VirtualTrail.declared}


def test_commands_go_before_everything_that_comes_in(manifest: Manifest) -> None:
    priorities = {t.name: t.priority for t in manifest.spec.topics}
    assert sorted(priorities, key=priorities.__getitem__) == ["odom", "wheels", "force", "cmd_vel"]


def test_defaults_are_the_lab_s_walker() -> None:
    walker, params = WalkerParams(), Params()
    assert (params.wheel_radius, params.wheel_track) == (walker.wheel_radius, walker.track)
    assert params.sensor_distance == walker.sensor_distance


def header(harness: Harness[VirtualTrail]) -> Header:
    return Header(Time.from_seconds(harness.now))


def test_from_messages_to_a_command() -> None:
    harness = Harness(VirtualTrail, STRAIGHT)
    harness.step()
    assert harness.newest("cmd_vel") is None
    pose = PoseWithCovariance(Pose(Point(1.0, 0.0), quaternion_from_yaw(0.1)))
    for _ in range(600):
        harness.send("force", WrenchStamped(header(harness), Wrench(Vector3(x=24.0))))
        harness.send("wheels", JointState(header(harness), ("left_wheel", "right_wheel"), [3.0, 4.0]))
        harness.send("odom", Odometry(header(harness), "base_link", pose))
        harness.step()
    # 12 N / 60 N s/m; heading to the left of the trail, so it turns right
    command = harness.newest("cmd_vel")
    assert isinstance(command, Twist)
    assert command.linear.x == pytest.approx(0.2)
    assert command.angular.z < -0.05


def test_wheels_are_found_by_name() -> None:
    stamp = Header(Time.from_seconds(2.5))
    assert wheels_of(JointState(stamp, ("arm", "right_wheel", "left_wheel"), [9.0, 2.0, 1.0])) == (2.5, 1.0, 2.0)
    assert wheels_of(JointState(stamp, ("left_wheel",), [1.0])) is None
    assert wheels_of(JointState(stamp, ("left_wheel", "right_wheel"), [1.0])) is None


def test_pose_is_taken_in_the_plane() -> None:
    message = Odometry(pose=PoseWithCovariance(Pose(Point(1.0, 2.0, 9.0), quaternion_from_yaw(-0.5))))
    assert pose_of(message) == pytest.approx((1.0, 2.0, -0.5))


@pytest.mark.parametrize(
    ("params", "sentence"),
    [
        ({"mass": 3}, "there is no parameter 'mass'"),
        ({"admittance_mass": -1}, "parameter 'admittance_mass'.*greater than 0"),
        ({"trail": []}, "parameter 'trail'"),
        ({"trail": [{"radius": 1.0, "angle": 0.0}]}, "segment 1 must be longer than 0 m"),
    ],
)
def test_wrong_parameters_get_one_sentence(params: dict[str, object], sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        Harness(VirtualTrail, params)
