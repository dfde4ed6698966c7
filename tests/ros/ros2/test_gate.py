"""The gate as nodes of a ROS 2 graph: a real Zenoh router, played sensors and wheels."""

import math
import os
import signal
import subprocess
import sys
import threading

import numpy as np
import pytest
import yaml
from gate_robot import release

from skytether.control.admittance import Velocity
from skytether.messages import Bool, LaserScan, TwistStamped, decode, encode, type_hash
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


@pytest.fixture
def folder(stage, tmp_path):
    """A running gate's folder."""
    path = tmp_path / "robot.yaml"
    safety = {
        "footprint": {"radius": 0.3},
        "sensors": {"/scan": {"max_age_s": 1.0}},
        "limits": {"max_gap_s": 0.5},
        "guard_s": 0.5,
        "enable": {"topic": "/motors_on"},
        "folder": str(tmp_path / "gate"),
    }
    graph = {"router": stage.router.address, "domain": stage.domain, "namespace": "/", "cmd_vel_type": STAMPED}
    path.write_text(yaml.safe_dump({"robot": "walker", "safety": safety, "ros2": graph}))
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    with (tmp_path / "log").open("wb") as log:
        command = [sys.executable, "-m", "skytether.cli", "robot", "gate", str(path)]
        process = subprocess.Popen(command, env=environment, stdout=log, stderr=log)
    yield tmp_path / "gate"
    process.send_signal(signal.SIGTERM)
    process.wait(30)
    assert "Traceback" not in (tmp_path / "log").read_text()


def test_the_wheels_of_a_ros_2_robot_are_behind_the_gate(stage, folder):
    base = stage.rmw("base")
    wheels = base.subscribe("/cmd_vel", DDS_STAMPED, type_hash(TwistStamped, "cdr"))
    power = base.subscribe("/motors_on", "std_msgs::msg::dds_::Bool_", type_hash(Bool, "cdr"))
    laser = base.publisher("/scan", DDS_SCAN, type_hash(LaserScan, "cdr"))
    link, ended = GateLink(folder), threading.Event()

    def play():
        while not ended.wait(0.04):
            laser(encode(SCAN))
            try:
                link.send(Velocity(0.2, 0.0))
            except OSError:  # no gate yet, or none at the moment
                continue

    def speed():
        return decode(TwistStamped, wheels.payloads[-1]).twist.linear.x if wheels.samples else None

    def gate():
        try:
            return ask(folder, {"do": "status"}, 30)["pid"]
        except GateError:
            return 0

    def start():
        """A person resets, and lets the agent go on with what it wants."""
        try:
            ask(folder, {"do": "reset"}, 30)
            return ask(folder, {"do": "start"}, 30)["started"]
        except GateError:
            return []

    agent = threading.Thread(target=play)
    agent.start()
    try:
        release(folder)
        stage.until(start, "the gate does not let the agent drive")
        stage.until(lambda: speed() is not None and speed() > 0.15, "the agent does not drive")
        stage.until(lambda: len({bytes(data) for data in power.payloads[-10:]}) == 2, "no enable signal")
        assert decode(TwistStamped, wheels.payloads[-1]).header.frame_id == "base_link"
        first = stage.until(gate, "the gate does not answer")
        os.kill(first, signal.SIGKILL)
        stage.until(lambda: speed() == 0.0, "the guard does not stop the wheels")
        stage.until(start, "the next gate does not let the agent drive")
        stage.until(lambda: speed() > 0.15, "the next gate does not drive")
        ask(folder, {"do": "stop"}, 30)
        stage.until(lambda: speed() == 0.0, "no emergency stop")
    finally:
        ended.set()
        agent.join()
        link.close()
