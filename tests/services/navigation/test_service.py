"""The shell of navigation, without a simulated world: manifest, requests, and what is wrong before it could drive."""

import importlib.util
import json
import math
import subprocess
import sys
from pathlib import Path as FilePath

import numpy as np
import pytest
import yaml

import skytether_services.navigation as package
from skytether.api.manifest import Manifest
from skytether.lab.world.robot import RobotParams
from skytether.messages import (
    Header,
    LaserScan,
    MapMetaData,
    OccupancyGrid,
    Odometry,
    Path,
    Point,
    Pose,
    PoseStamped,
    PoseWithCovariance,
    SetBoolRequest,
    TFMessage,
    Time,
    Transform,
    TransformStamped,
    TriggerRequest,
    Twist,
    Vector3,
)
from skytether.service import ConfigError, params_schema
from skytether.testing.service import Harness
from skytether_services.navigation.conversions import costmap_message
from skytether_services.navigation.costmap import Costmap
from skytether_services.navigation.params import FootprintParams
from skytether_services.navigation.service import Navigation

DWA = {"controller": "dwa"}
"""Its constructor compiles nothing."""
EMPTY_ROOM = OccupancyGrid(
    Header(frame_id="map"), MapMetaData(resolution=0.1, width=40, height=40), np.zeros(1600, dtype=np.int8)
)


@pytest.fixture(scope="module")
def manifest() -> Manifest:
    text = FilePath(package.__file__).with_name("service.yaml").read_text()
    return Manifest.model_validate(yaml.safe_load(text))


def served(tmp_path: FilePath, **params: object) -> Harness[Navigation]:
    return Harness(Navigation, {**DWA, **params}, data_dir=tmp_path)


def status(harness: Harness[Navigation]) -> dict[str, object]:
    newest: dict[str, object] = json.loads(harness.newest("status").data)
    return newest


def told(harness: Harness[Navigation]) -> tuple[object, object]:
    harness.step()
    return status(harness)["state"], status(harness)["code"]


def goal(x: float, y: float, frame: str = "map") -> PoseStamped:
    return PoseStamped(Header(frame_id=frame), Pose(Point(x, y)))


def sense(harness: Harness[Navigation], *, laser: str = "laser", ranges: float = 2.0) -> None:
    stamp = Time.from_seconds(harness.now)
    base = TransformStamped(Header(stamp, "odom"), "base_link", Transform(Vector3(1.0)))
    mounted = TransformStamped(Header(stamp, "/base_link"), "/laser", Transform(Vector3(0.2)))
    harness.send("tf", TFMessage((base, mounted)))
    harness.send("odom", Odometry(Header(stamp, "odom"), "base_link", PoseWithCovariance(Pose(Point(1.0)))))
    values = np.full(90, ranges, dtype=np.float32)
    harness.send(
        "scan",
        LaserScan(Header(stamp, laser), -1.5, 1.5, 3 / 89, range_min=0.05, range_max=20.0, ranges=values),
    )


def test_manifest_s_schema_is_the_dataclass_s(manifest: Manifest) -> None:
    assert manifest.spec.params == params_schema(Navigation)


@pytest.mark.parametrize("service", ["navigation", "follow-in-front"])
def test_the_page_of_parameters_is_current(service: str) -> None:
    root = FilePath(__file__).parents[3]
    spec = importlib.util.spec_from_file_location("parameters", root / ".ci" / "parameters.py")
    assert spec is not None
    assert spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    assert (root / "docs" / f"{service}-parameters.md").read_text() == script.page(service), "run `make docs`"


def test_manifest_s_topics_are_the_class_s(manifest: Manifest) -> None:
    listed = {(t.name, t.kind, t.type, t.direction) for t in manifest.spec.topics}
    assert listed == {(d.topic, d.kind, d.type_name, str(d.direction)) for d in Navigation.declared}


def test_the_thesis_s_topics_go_before_all_others(manifest: Manifest) -> None:
    rows = {t.name: (t.direction, t.priority, t.period_ms) for t in manifest.spec.topics}
    first = {name: rows.pop(name) for name in ("tf", "odom", "scan", "cmd_vel")}
    assert first == {
        "tf": ("in", 127, 10), "odom": ("in", 126, 100), "scan": ("in", 125, 120), "cmd_vel": ("out", 127, 33),
    }  # fmt: skip
    assert max(priority for _, priority, _ in rows.values()) < 125


def test_default_outline_is_the_lab_s_robot() -> None:
    corners = FootprintParams().footprint.corners
    assert np.array(corners) == pytest.approx(np.array(RobotParams().footprint()))


@pytest.mark.parametrize(
    ("params", "said"),
    [
        ({"controler": "dwa"}, "there is no parameter 'controler'"),
        ({"controller": "pid"}, "'controller'"),
        ({"goals": [{"x": 1.0}]}, "parameter 'goals.0.y' is missing"),
        ({"footprint": {"corners": [{"x": 1.0, "y": 0.0}]}}, "corners must be at least 3"),
        ({"behaviours": "/nowhere/tree.yaml"}, "behaviours: /nowhere/tree.yaml cannot be read"),
    ],
)
def test_wrong_parameters_are_refused_at_the_start(tmp_path: FilePath, params: dict[str, object], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        served(tmp_path, **params)


def test_without_a_goal_it_waits_and_stands(tmp_path: FilePath) -> None:
    harness = served(tmp_path)
    assert told(harness) == ("waiting", "no_odometry")
    assert harness.newest("cmd_vel") == Twist()


def test_what_is_missing_is_told_one_after_the_other(tmp_path: FilePath) -> None:
    harness = served(tmp_path, goals=[{"x": 1.0, "y": 1.0}])
    assert told(harness) == ("standing", "no_odometry")
    sense(harness)
    assert told(harness) == ("standing", "no_map")
    sense(harness, ranges=math.nan)
    assert told(harness) == ("standing", "scan_useless")
    sense(harness, ranges=math.inf)
    assert told(harness) == ("standing", "scan_useless")
    sense(harness, laser="other")
    assert told(harness) == ("standing", "no_laser_pose")
    for _ in range(19):  # 0.63 s
        sense_odometry_only(harness)
        harness.step()
    assert told(harness)[1] in ("no_scan", "no_laser_pose")
    assert harness.newest("cmd_vel") == Twist()


def test_a_tf_message_of_a_hundred_thousand_frames_is_not_read(tmp_path: FilePath) -> None:
    """It would take seconds, in which no velocity comes."""
    harness = served(tmp_path)
    one = TransformStamped(Header(Time(), "odom"), "base_link", Transform())
    harness.send("tf", TFMessage((one,) * 3000))
    harness.step()
    assert harness.service.tf.undecodable == 1


def sense_odometry_only(harness: Harness[Navigation]) -> None:
    harness.send("odom", Odometry(Header(Time.from_seconds(harness.now), "odom"), "base_link"))


def test_a_laser_that_falls_silent_is_told(tmp_path: FilePath) -> None:
    harness = served(tmp_path)
    sense(harness)
    harness.step()
    for _ in range(20):
        sense_odometry_only(harness)
        harness.step()
    assert status(harness)["code"] == "no_scan"


@pytest.mark.parametrize(
    ("files", "said"),
    [
        ({}, "cannot be read"),
        ({"map.yaml": "{}"}, "resolution is missing"),
        ({"map.yaml": "image: map.pgm\nresolution: 0.05\norigin: [0, 0, 0]\n"}, "map.pgm: it cannot be read"),
        (
            {"map.yaml": "image: map.pgm\nresolution: 0.05\norigin: [0, 0, 0]\n", "map.pgm": "P5 20 20 255 few"},
            "ends after",
        ),
    ],
)
def test_a_broken_map_is_told_and_another_may_come(tmp_path: FilePath, files: dict[str, str], said: str) -> None:
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    harness = served(tmp_path, map="map.yaml", goals=[{"x": 1.0, "y": 1.0}])
    assert told(harness) == ("standing", "map_broken")
    assert said in str(status(harness)["message"])
    assert harness.newest("cmd_vel") == Twist()
    harness.send("map", EMPTY_ROOM)
    sense_odometry_only(harness)
    assert told(harness) == ("standing", "no_scan")


def reported(harness: Harness[Navigation]) -> list[str]:
    return [report.code for report in harness.service.reports.recent]


def test_what_lasts_is_an_event_of_the_instance_and_so_is_each_end(tmp_path: FilePath) -> None:
    harness = served(tmp_path, goals=[{"x": 1.0, "y": 1.0}])
    for _ in range(25):  # 0.83 s
        harness.step()
    assert reported(harness) == []
    for _ in range(10):
        harness.step()
    assert reported(harness) == ["no_odometry"]
    harness.send("goals", Path())
    harness.step()
    assert reported(harness) == ["no_odometry", "no_goals"]
    harness.send("goal", goal(1.0, 0.0, "odom"))
    harness.step()
    harness.send("goal", goal(1.0, 0.0, "world"))
    for _ in range(60):
        harness.step()
    assert reported(harness) == ["no_odometry", "no_goals", "bad_goal", "bad_goal"]
    assert "'world'" in harness.service.reports.recent[-1].message


@pytest.mark.slow  # it localises, and numba may have to compile
def test_that_there_is_no_goal_yet_is_no_event(tmp_path: FilePath) -> None:
    harness = served(tmp_path, start={"x": 1.0, "y": 1.0})
    harness.send("map", EMPTY_ROOM)
    for _ in range(60):
        sense(harness)
        harness.step()
    assert told(harness) == ("waiting", "ok")
    assert reported(harness) == []


def test_a_map_message_whose_size_is_wrong_is_told(tmp_path: FilePath) -> None:
    harness = served(tmp_path)
    harness.send("map", OccupancyGrid(info=MapMetaData(resolution=0.1, width=40, height=41), data=EMPTY_ROOM.data))
    assert told(harness) == ("waiting", "map_broken")


def test_goals_come_by_topic(tmp_path: FilePath) -> None:
    harness = served(tmp_path, rounds=3)
    harness.send("goal", goal(1.0, 2.0))
    assert told(harness)[0] == "standing"
    assert (status(harness)["target"], status(harness)["rounds"]) == ([1.0, 2.0, 0.0], 1)
    harness.send("goals", Path(poses=(goal(3.0, 4.0), goal(5.0, 6.0, "/map"))))
    harness.step()
    assert (status(harness)["goals"], status(harness)["target"], status(harness)["rounds"]) == (2, [3.0, 4.0, 0.0], 3)


@pytest.mark.parametrize(
    ("topic", "message", "code"),
    [
        ("goals", Path(), "no_goals"),
        ("goal", goal(math.nan, 0.0), "bad_goal"),
        ("goal", goal(1.0, 0.0, "odom"), "bad_goal"),
        ("goals", Path(poses=(goal(1.0, 0.0), goal(1.0, 0.0, "world"))), "bad_goal"),
    ],
)
def test_a_request_that_cannot_be_one_fails_and_the_robot_stands(
    tmp_path: FilePath, topic: str, message: Path | PoseStamped, code: str
) -> None:
    harness = served(tmp_path, goals=[{"x": 1.0, "y": 1.0}])
    harness.step()
    harness.send(topic, message)
    assert told(harness) == ("failed", code)
    assert harness.newest("cmd_vel") == Twist()
    harness.send("goal", goal(1.0, 2.0))
    assert told(harness)[0] == "standing"


def test_it_is_paused_resumed_and_canceled_by_calls(tmp_path: FilePath) -> None:
    harness = served(tmp_path)
    assert not harness.call("cancel", TriggerRequest()).success
    assert not harness.call("pause", SetBoolRequest(True)).success
    harness.send("goal", goal(1.0, 2.0))
    harness.step()
    assert harness.call("pause", SetBoolRequest(True)).success
    assert told(harness) == ("paused", "ok")
    assert harness.call("pause", SetBoolRequest(False)).success
    assert told(harness)[0] == "standing"
    assert harness.call("cancel", TriggerRequest()).success
    assert told(harness) == ("canceled", "ok")
    assert harness.call("clear_costmaps", TriggerRequest()).success


def test_costs_are_published_as_costmap_2d_does() -> None:
    costs = np.array([[0, 1, 126], [252, 253, 254], [255, 0, 0]], dtype=np.uint8)
    message = costmap_message(Costmap(costs, 0.05, (1.0, 2.0)), 0.0)
    assert message.data.tolist() == [0, 0, 49, 98, 99, 100, -1, 0, 0]
    assert (message.info.width, message.info.height, message.info.origin.position.x) == (3, 3, 1.0)


@pytest.mark.slow  # another process loads all of the service
def test_who_only_drives_waits_for_no_scipy() -> None:
    said = "import sys, skytether_services.navigation.service; print('scipy.linalg' in sys.modules)"
    done = subprocess.run([sys.executable, "-P", "-c", said], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
