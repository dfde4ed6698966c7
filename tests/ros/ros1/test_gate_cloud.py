"""A depth camera of a real ROS 1 graph, 640 by 480, behind it the real gate."""

import threading

import numpy as np
import pytest
import yaml
from depth_camera import Camera, Face, cloud_of, optical
from gate_robot import release
from ros1_graph import wait_for

from skytether.control.admittance import Velocity
from skytether.messages import PointCloud2, encode, type_hash
from skytether.robot.safety.client import GateError, GateLink, ask

pytestmark = [pytest.mark.ros1, pytest.mark.slow]

CAMERA = Camera(width=640, height=480, x=0.2)
TOPIC = "/camera/depth/points"


def cloud(*faces: Face) -> bytes:
    return encode(cloud_of(optical(CAMERA.see(faces)), frame="camera_depth_optical_frame"), "ros1")


@pytest.fixture
def folder(graph, tmp_path):
    """A running gate's folder."""
    path, folder = tmp_path / "robot.yaml", tmp_path / "gate"
    depth = {"kind": "points", "x": 0.2, "z": 0.4, "pitch_deg": 15, "max_z_m": 1.0, "range_max": 5.0, "max_age_s": 1.0}
    safety = {
        "footprint": {"radius": 0.3},
        "sensors": {TOPIC: depth},
        "unseen": {"action": "free"},
        "limits": {"max_gap_s": 0.5},
        "guard_s": 0.5,
        "folder": str(folder),
    }
    path.write_text(
        yaml.safe_dump({"robot": "walker", "safety": safety, "ros1": {"master": graph.uri, "namespace": "/"}})
    )
    graph.skytether("robot", "gate", str(path))
    return folder


def test_a_depth_camera_of_a_ros_1_graph_stops_the_wheels(walker, folder):
    sent, ended = [cloud()], threading.Event()
    camera = walker.node.advertise(TOPIC, "sensor_msgs/PointCloud2", type_hash(PointCloud2, "ros1"))
    link = GateLink(folder)

    def play():
        turn = 0
        while not ended.wait(0.04):
            turn += 1
            if turn % 3 == 0:
                camera.publish(sent[-1])
            try:
                link.send(Velocity(0.2, 0.0))
            except OSError:  # no gate yet
                continue

    def start() -> bool:
        """A person lets the agent go on with what it wants."""
        try:
            return bool(ask(folder, {"do": "start"}, 30)["started"])
        except GateError:
            return False

    def drives() -> bool:
        return walker.speed is not None and walker.speed > 0.15

    def says(sentence: str) -> bool:
        return sentence in str(ask(folder, {"do": "status"}, 30))

    agent = threading.Thread(target=play)
    agent.start()
    try:
        release(folder)
        wait_for(start, "the agent may drive")
        wait_for(drives, "the agent to drive")
        sent.append(cloud(Face(0.38, up=(0.3, 0.5))))
        wait_for(lambda: walker.speed == 0.0, "the standstill before a bar")
        wait_for(lambda: says("'zone': 'stop'"), "the stop zone")
        sent.append(cloud())
        wait_for(drives, "the agent to drive again")
        sent.append(encode(cloud_of(np.full((480, 640, 3), np.nan), frame="camera_depth_optical_frame"), "ros1"))
        wait_for(lambda: walker.speed == 0.0, "the standstill of a blind robot")
        wait_for(lambda: says("is blind: no reading at all"), "what is wrong")
    finally:
        ended.set()
        agent.join()
        link.close()
