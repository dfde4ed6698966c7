"""The gate as nodes of a ROS 2 graph: a real Zenoh router, played sensors and wheels."""

import math
import os
import signal
import subprocess
import sys
import threading
from contextlib import contextmanager

import numpy as np
import pytest
import yaml
from depth_camera import Camera, Face, cloud_of
from gate_robot import release

from skytether.control.admittance import Velocity
from skytether.messages import Bool, LaserScan, PointCloud2, TwistStamped, decode, encode, type_hash
from skytether.robot.safety.client import GateError, GateLink, ask

pytestmark = pytest.mark.slow

STAMPED, DDS_STAMPED = TwistStamped.TYPE, "geometry_msgs::msg::dds_::TwistStamped_"
DDS_SCAN = "sensor_msgs::msg::dds_::LaserScan_"
SCAN = LaserScan(
    angle_min=-math.pi / 2,
    angle_increment=math.pi / 180,
    range_min=0.05,
    range_max=8.0,
    ranges=np.full(181, 4.0, dtype=np.float32),
)


@contextmanager
def running(stage, tmp_path, **more):
    """A running gate's folder."""
    path = tmp_path / "robot.yaml"
    safety = {
        "footprint": {"radius": 0.3},
        "limits": {"max_gap_s": 0.5},
        "guard_s": 0.5,
        "enable": {"topic": "/motors_on"},
        "folder": str(tmp_path / "gate"),
        **more,
    }
    graph = {
        "dialect": "rmw_zenoh",
        "router": stage.router.address,
        "domain": stage.domain,
        "namespace": "/",
        "cmd_vel_type": STAMPED,
    }
    path.write_text(yaml.safe_dump({"robot": "walker", "safety": safety, "ros2": graph}))
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    with (tmp_path / "log").open("wb") as log:
        command = [sys.executable, "-m", "skytether.cli", "robot", "gate", str(path)]
        process = subprocess.Popen(command, env=environment, stdout=log, stderr=log)
    yield tmp_path / "gate"
    process.send_signal(signal.SIGTERM)
    process.wait(30)
    assert "Traceback" not in (tmp_path / "log").read_text()


@pytest.fixture
def folder(stage, tmp_path):
    with running(stage, tmp_path, sensors={"/scan": {"max_age_s": 1.0}}) as folder:
        yield folder


@contextmanager
def played(folder, sense):
    """An agent that wants to drive, and a driver that senses, until the end."""
    link, ended = GateLink(folder), threading.Event()

    def play():
        while not ended.wait(0.04):
            sense()
            try:
                link.send(Velocity(0.2, 0.0))
            except OSError:  # no gate yet, or none at the moment
                continue

    thread = threading.Thread(target=play)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        link.close()


def speed_of(wheels):
    return decode(TwistStamped, wheels.payloads[-1]).twist.linear.x if wheels.samples else None


def start(folder):
    """A person resets, and lets the agent go on with what it wants."""
    try:
        ask(folder, {"do": "reset"}, 30)
        return ask(folder, {"do": "start"}, 30)["started"]
    except GateError:
        return []


def test_the_wheels_of_a_ros_2_robot_are_behind_the_gate(stage, folder):
    base = stage.rmw("base")
    wheels = base.subscribe("/cmd_vel", DDS_STAMPED, type_hash(TwistStamped, "cdr"))
    power = base.subscribe("/motors_on", "std_msgs::msg::dds_::Bool_", type_hash(Bool, "cdr"))
    laser = base.publisher("/scan", DDS_SCAN, type_hash(LaserScan, "cdr"))

    def gate():
        try:
            return ask(folder, {"do": "status"}, 30)["pid"]
        except GateError:
            return 0

    def speed():
        return speed_of(wheels)

    def go():
        return start(folder)

    with played(folder, lambda: laser(encode(SCAN))):
        release(folder)
        stage.until(go, "the gate does not let the agent drive")
        stage.until(lambda: speed() is not None and speed() > 0.15, "the agent does not drive")
        stage.until(lambda: len({bytes(data) for data in power.payloads[-10:]}) == 2, "no enable signal")
        assert decode(TwistStamped, wheels.payloads[-1]).header.frame_id == "base_link"
        first = stage.until(gate, "the gate does not answer")
        os.kill(first, signal.SIGKILL)
        stage.until(lambda: speed() == 0.0, "the guard does not stop the wheels")
        stage.until(go, "the next gate does not let the agent drive")
        stage.until(lambda: speed() > 0.15, "the next gate does not drive")
        ask(folder, {"do": "stop"}, 30)
        stage.until(lambda: speed() == 0.0, "no emergency stop")


CAMERA = Camera(width=80, height=60, x=0.2)
DEPTH = {"kind": "points", "x": 0.2, "z": 0.4, "pitch_deg": 15, "max_z_m": 1.0, "range_max": 5.0, "max_age_s": 1.0}


def test_a_depth_camera_of_a_ros_2_robot_stops_it_before_what_it_sees_and_when_it_does_not_see(stage, tmp_path):
    base = stage.rmw("base")
    wheels = base.subscribe("/cmd_vel", DDS_STAMPED, type_hash(TwistStamped, "cdr"))
    topic, dds = "/camera/depth/points", "sensor_msgs::msg::dds_::PointCloud2_"
    camera = base.publisher(topic, dds, type_hash(PointCloud2, "cdr"))
    clear = encode(cloud_of(CAMERA.see(), step=16))
    bar = encode(cloud_of(CAMERA.see([Face(0.38, up=(0.3, 0.5))]), step=16))
    blind = encode(cloud_of(np.full((60, 80, 3), np.nan), step=16))
    cloud = clear

    def status():
        return str(ask(folder, {"do": "status"}, 30))

    with (
        running(stage, tmp_path, sensors={topic: DEPTH}, unseen={"action": "free"}) as folder,
        played(folder, lambda: cloud and camera(cloud)),
    ):
        release(folder)
        for cloud, says in ((bar, "'zone': 'stop'"), (blind, "points: is blind"), (b"", "points: is stale")):
            wanted, cloud = cloud, clear
            stage.until(lambda: start(folder) and speed_of(wheels), "the agent does not drive")
            stage.until(lambda: speed_of(wheels) > 0.15, "the agent does not drive as fast as it wants")
            cloud = wanted
            stage.until(lambda: speed_of(wheels) == 0.0, f"the gate does not stop the wheels: {says}")
            stage.until(lambda says=says: says in status(), f"the gate does not say: {says}")
