"""Recordings of legs: what is read of them, how they are judged, and what is said of those that cannot be used."""

from __future__ import annotations

import json
import math
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
from leg_scans import FIRST, LIMITS, STEP, feet, scan
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from typer.testing import CliRunner

from skytether.cli.commands.lab.app import app
from skytether.lab.leg_bag import read_leg_bag
from skytether.messages import (
    Header,
    LaserScan,
    Message,
    Odometry,
    Point,
    Pose,
    PoseWithCovariance,
    TFMessage,
    Time,
    Transform,
    TransformStamped,
    TwistWithCovariance,
    Vector3,
    encode,
    quaternion_from_yaw,
)
from skytether.robot.replay.bag import BagError

PERIOD = 0.1
MOUNT = (-0.2, 0.05, math.pi)
"""The laser looks back."""
TYPES = {
    "/scan": "sensor_msgs/msg/LaserScan",
    "/other_scan": "sensor_msgs/msg/LaserScan",
    "/odom": "nav_msgs/msg/Odometry",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/ground_truth_people_tracks": "leg_tracker/msg/Person",
}


def write(path: Path, messages: list[tuple[str, float, bytes]]) -> Path:
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg("geometry_msgs/Pose pose\nuint32 id\n", "leg_tracker/msg/Person"))
    store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
    with Writer(path) as writer:
        names = dict.fromkeys(topic for topic, _, _ in messages)
        of = {name: writer.add_connection(name, TYPES[name], typestore=store) for name in names}
        for topic, at, data in messages:
            writer.write(of[topic], round(at * 1e9), data)
    return path


def ros1(message: Message) -> bytes:
    return encode(message, "ros1")


def scan_of(ranges: np.ndarray, at: float) -> bytes:
    return ros1(
        LaserScan(
            Header(Time.from_seconds(at), "/laser"),
            angle_min=FIRST,
            angle_max=FIRST + STEP * (len(ranges) - 1),
            angle_increment=STEP,
            range_min=LIMITS[0],
            range_max=LIMITS[1],
            ranges=ranges,
        )
    )


def robot_at(at: float) -> tuple[float, float, float]:
    """It drives 0.3 m/s and swings."""
    return 0.3 * at, 0.0, 0.3 * math.sin(at)


def laser_at(at: float) -> tuple[float, float, float]:
    x, y, heading = robot_at(at)
    cos, sin = math.cos(heading), math.sin(heading)
    return x + cos * MOUNT[0] - sin * MOUNT[1], y + sin * MOUNT[0] + cos * MOUNT[1], heading + MOUNT[2]


def odometry_at(at: float) -> bytes:
    x, y, heading = robot_at(at)
    pose = Pose(Point(x, y), quaternion_from_yaw(heading))
    return ros1(
        Odometry(Header(Time.from_seconds(at), "odom"), "base_link", PoseWithCovariance(pose), TwistWithCovariance())
    )


def mount() -> bytes:
    transform = Transform(Vector3(MOUNT[0], MOUNT[1], 0.2), quaternion_from_yaw(MOUNT[2]))
    return ros1(TFMessage((TransformStamped(Header(Time(90), "/base_link"), "/laser", transform),)))


def walk(*, truth: bool, seconds: float = 5.0) -> list[tuple[str, float, bytes]]:
    """Somebody walks across behind a robot that drives; annotated from the second second on."""
    random = np.random.default_rng(1)
    messages = [("/tf", 100.0, mount())]
    for number in range(round(seconds / PERIOD)):
        at = 100 + number * PERIOD
        place = (28.5, -2.0 + 0.8 * (at - 100))
        laser = laser_at(at)
        ranges = scan(feet(place, math.pi / 2, place[1]), [((24.0, -6.0), (24.0, 6.0))], laser, random)
        messages += [("/odom", at, odometry_at(at)), ("/scan", at, scan_of(ranges, at))]
        if truth and at >= 101.5:
            dx, dy = place[0] - laser[0], place[1] - laser[1]
            cos, sin = math.cos(laser[2]), math.sin(laser[2])
            person = struct.pack("<7dI", cos * dx + sin * dy, cos * dy - sin * dx, 0, 0, 0, 0, 1, 4)
            messages.append(("/ground_truth_people_tracks", at + 0.05, person))
    return messages


def test_scans_poses_and_truth_are_read(tmp_path: Path) -> None:
    bag = read_leg_bag(write(tmp_path / "a.bag", walk(truth=True)))
    assert (bag.topic, len(bag.stamps), bag.moved) == ("/scan", 50, True)
    np.testing.assert_allclose(bag.stamps, 100 + PERIOD * np.arange(50), atol=1e-6)
    expected = np.array([laser_at(at) for at in bag.stamps.tolist()])
    np.testing.assert_allclose(bag.lasers, expected, atol=1e-6)
    assert (bag.first, bag.step) == (pytest.approx(FIRST), pytest.approx(STEP))
    assert bag.truth is not None
    assert [len(people) for people in bag.truth] == [0] * 15 + [1] * 35
    assert set(bag.truth[-1]) == {4}


@pytest.mark.slow
def test_people_are_judged_by_the_truth(tmp_path: Path) -> None:
    plain = write(tmp_path / "a.bag", walk(truth=True))
    packed = tmp_path / "a.bag.zip"
    with zipfile.ZipFile(packed, "w") as archive:
        archive.write(plain, "a.bag")
    for path in (plain, packed):
        result = CliRunner().invoke(app, ["bench", "legs", str(path)])
        assert result.exit_code == 0, result.output
        figures = json.loads(result.stdout)
        assert (figures["judged_by"], figures["truths"], figures["switches"]) == ("truth", 35, 0)
        assert figures["misses"] <= 3
        assert figures["false_positives"] == 0
        assert figures["mota"] > 0.9
        assert figures["motp_m"] < 0.15
        assert figures["odometry"] is True
        assert figures["detections_per_scan"] >= 1
        assert set(figures["ms_per_scan"]) == {"mean", "p99", "worst"}
    # Between angles where nobody was, there is nothing to judge.
    result = CliRunner().invoke(app, ["bench", "legs", str(plain), "--angles", "100", "120"])
    figures = json.loads(result.stdout)
    assert (figures["truths"], figures["mota"], figures["angles_deg"]) == (0, None, [100.0, 120.0])


@pytest.mark.slow
def test_without_a_truth_tracks_are_judged_by_each_other(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["bench", "legs", str(write(tmp_path / "a.bag", walk(truth=False)))])
    assert result.exit_code == 0, result.output
    figures = json.loads(result.stdout)
    assert (figures["judged_by"], figures["tracks"], figures["switches"]) == ("tracks", 1, 0)
    assert "mota" not in figures


def test_scans_alone_are_enough(tmp_path: Path) -> None:
    only = [message for message in walk(truth=False) if message[0] == "/scan"]
    bag = read_leg_bag(write(tmp_path / "a.bag", only))
    assert not bag.moved
    assert not bag.lasers.any()
    assert bag.truth is None


def test_stamps_that_do_not_rise_give_way_to_the_times_of_recording(tmp_path: Path) -> None:
    empty = np.full(10, np.inf, np.float32)
    bag = read_leg_bag(write(tmp_path / "a.bag", [("/scan", 10.0 + n, scan_of(empty, 5.0)) for n in range(3)]))
    np.testing.assert_allclose(np.diff(bag.stamps), 1.0, atol=1e-3)


def test_what_cannot_be_used_is_said(tmp_path: Path) -> None:
    scans = [("/other_scan", 1.0, scan_of(np.ones(4, np.float32), 1.0))]
    two = write(tmp_path / "two.bag", [*scans, ("/scan", 1.1, scans[0][2])])
    assert read_leg_bag(two).topic == "/scan"
    assert read_leg_bag(two, "/other_scan").topic == "/other_scan"
    with pytest.raises(BagError, match=r"--topic\); there is /other_scan, /scan"):
        read_leg_bag(two, "/third")
    none = write(tmp_path / "none.bag", [("/odom", 1.0, odometry_at(1.0))])
    with pytest.raises(BagError, match="there is none"):
        read_leg_bag(none)
    damaged = write(tmp_path / "damaged.bag", [("/scan", 1.0, b"\x01\x02\x03")])
    with pytest.raises(BagError, match="a message of /scan is damaged"):
        read_leg_bag(damaged)
    short = write(tmp_path / "short.bag", [("/scan", 1.0, scans[0][2]), ("/ground_truth_people_tracks", 1.0, b"\0")])
    with pytest.raises(BagError, match="ground_truth_people_tracks is damaged"):
        read_leg_bag(short)
    packed = tmp_path / "packed.zip"
    packed.write_bytes(b"no archive")
    with pytest.raises(BagError, match="cannot be unpacked"):
        read_leg_bag(packed)
    with zipfile.ZipFile(packed, "w") as archive:
        archive.writestr("readme.txt", "nothing")
    with pytest.raises(BagError, match="is to hold one ROS 1 bag"):
        read_leg_bag(packed)
    result = CliRunner().invoke(app, ["bench", "legs", str(none)])
    assert result.exit_code == 1
    assert not result.stdout


@pytest.mark.slow
@pytest.mark.data
def test_people_in_a_real_recording_of_a_moving_robot(data_dir: Path) -> None:
    # Leigh et al. (ICRA 2015, table III) report MOTA 10.2 % and MOTP 0.15 m over the set that this bag is of.
    bag = data_dir / "legs" / "general_tracking_moving_1.bag.zip"
    result = CliRunner().invoke(app, ["bench", "legs", str(bag)])
    assert result.exit_code == 0, result.output
    figures = json.loads(result.stdout)
    assert (figures["scans"], figures["truths"], figures["odometry"]) == (873, 153, True)
    assert figures["mota"] >= 0.15
    assert figures["motp_m"] <= 0.15
    assert figures["switches"] <= 2


@pytest.mark.slow
@pytest.mark.data
def test_the_one_who_walks_behind_a_real_robot_is_one_track_for_each_time_they_come(data_dir: Path) -> None:
    result = CliRunner().invoke(app, ["bench", "legs", str(data_dir / "legs" / "positive_7.bag")])
    assert result.exit_code == 0, result.output
    figures = json.loads(result.stdout)
    assert (figures["topic"], figures["scans"], figures["switches"]) == ("/rear_scan", 510, 0)
