"""The gate as nodes of a real ROS 1 graph, with a real agent, bridge and service beside it that are killed."""

import socket
import subprocess
import time
from contextlib import closing
from itertools import pairwise
from urllib.parse import urlsplit

import numpy as np
import pytest
import yaml
from gate_robot import release
from ros1_graph import wait_for

from skytether.guard.velocity import Velocity
from skytether.messages import Bool, Joy, LaserScan, Twist, decode, encode, type_hash
from skytether.robot.graphs.gate_io import WheelsTiming
from skytether.robot.graphs.ros1.gate_io import Ros1Wheels
from skytether.robot.graphs.ros1.kind import Ros1Way
from skytether.robot.safety.client import GateError, ask
from skytether.ros.ros1.node import Node
from skytether.ros.ros1.subscription import Listener
from skytether.ros.ros1.tcpros import pack_header

pytestmark = [pytest.mark.ros1, pytest.mark.slow]


@pytest.fixture
def gated(config, tmp_path):
    """The robot.yaml with a section safety."""
    document = yaml.safe_load(config.read_text())
    document["safety"] = {
        "footprint": {"radius": 0.3},
        "sensors": {"/scan": {"max_age_s": 1.0}},
        "joystick": {"topic": "/joy", "deadman": 0, "max_age_s": 1.0},
        "estop": {"topic": "/estop", "max_age_s": None},
        "guard_s": 0.5,
        "enable": {"topic": "/motors_on"},
        "folder": str(tmp_path / "gate"),
    }
    config.write_text(yaml.safe_dump(document))
    return config


def stands(walker):
    wait_for(lambda: walker.speed == 0.0, "the standstill")


def drives(walker):
    wait_for(lambda: walker.speed is not None and walker.speed > 0.15, "the service to drive")


def test_the_wheels_of_a_ros_1_robot_are_behind_the_gate(graph, gated, walker, tmp_path):
    folder = tmp_path / "gate"
    said = (tmp_path / "gate.log").open("wb")
    guard = graph.skytether("robot", "gate", str(gated), stdout=said, stderr=said)
    said.close()
    agent = graph.skytether("robot", "run", str(gated))
    button = graph.start("rostopic", "pub", "-r", "5", "/estop", "std_msgs/Bool", "data: false")
    release(folder)
    # The service may have been quicker than the gate and its reset, and wants to drive from its first command.
    wait_for(lambda: ask(folder, {"do": "start"}, 30)["started"] == ["agent"], "the agent to be let go")
    drives(walker)
    levels = []
    listener = Listener(lambda data, _: levels.append(decode(Bool, data, "ros1").data))
    walker.node.subscribe("/motors_on", "std_msgs/Bool", type_hash(Bool, "ros1"), listener)
    wait_for(lambda: sum(a != b for a, b in pairwise(levels)) > 10, "the enable signal")
    assert set(graph.publishers("/cmd_vel")) == {"/skytether_guard", "/skytether_gate"}
    # The agent, and with it its bridge, is killed at full speed.
    agent.kill()
    stands(walker)
    agent = graph.skytether("robot", "run", str(gated))
    drives(walker)
    # Something comes nearer than the service, 0.5 m from its walls, would let it.
    walker.scan = LaserScan(angle_min=-1.0, angle_increment=0.01, range_max=10.0, ranges=[3.0] * 100 + [0.35] * 100)
    stands(walker)
    walker.scan = LaserScan(angle_min=-1.0, angle_increment=0.01, range_max=10.0, ranges=[3.0] * 200)
    drives(walker)
    # The master dies: who is connected stays connected.
    graph.kill_master()
    pad = walker.node.advertise("/joy", "sensor_msgs/Joy", type_hash(Joy, "ros1"))
    graph.start_master()
    held = Joy(axes=np.zeros(2, dtype=np.float32), buttons=np.array([1], dtype=np.int32))
    up = Joy(axes=np.zeros(2, dtype=np.float32), buttons=np.zeros(1, dtype=np.int32))

    def joystick_drives() -> bool:
        """Seen up for long enough, a press counts."""
        for message in (*[up] * 8, held):
            pad.publish(encode(message, "ros1"))
            time.sleep(0.05)
        return ask(folder, {"do": "status"}, 30)["hand"] == "joystick"

    wait_for(joystick_drives, "the joystick")
    pad.publish(encode(up, "ros1"))
    drives(walker)
    # The emergency stop button, pressed by a node of the robot.
    graph.end(button)
    graph.ask("rostopic", "pub", "-1", "/estop", "std_msgs/Bool", "data: true")
    wait_for(lambda: "button was pressed" in ask(folder, {"do": "status"}, 30)["stopped"], "the button")
    stands(walker)
    with pytest.raises(GateError, match="still pressed"):
        ask(folder, {"do": "reset"}, 30)
    graph.ask("rostopic", "pub", "-1", "/estop", "std_msgs/Bool", "data: false")

    def released() -> bool:
        try:
            return not ask(folder, {"do": "reset"}, 30)["stopped"]
        except GateError:
            return False

    wait_for(released, "the reset")
    ask(folder, {"do": "start"}, 30)
    drives(walker)
    # The guard itself is killed: the gate has a publisher of its own.
    guard.kill()
    stands(walker)
    time.sleep(0.5)
    levels.clear()
    time.sleep(0.5)
    assert not levels
    assert "Traceback" not in (tmp_path / "gate.log").read_text()


def test_a_velocity_that_waits_in_a_writer_that_stands_still_is_never_told(graph, walker, monkeypatch):
    """It stands between two threads: the velocity is handed over, and not sent yet."""
    nodes, start = [], Node.start
    monkeypatch.setattr(Node, "start", lambda node: (nodes.append(node), start(node)))
    wheels = Ros1Wheels(Ros1Way(master=graph.uri, cmd_vel="/told"), "guard", WheelsTiming(0.1, 0.1, 0.1, 1.0))
    told = []
    listener = Listener(lambda data, _: told.append(decode(Twist, data, "ros1").linear.x))
    walker.node.subscribe("/told", Twist.TYPE, type_hash(Twist, "ros1"), listener)
    wait_for(wheels.listeners, "the wheels to listen")
    nodes[0].soon(lambda: time.sleep(0.5))
    wheels.write(Velocity(0.5, 0.0))
    time.sleep(0.6)
    wait_for(lambda: wheels.write(Velocity(0.1, 0.0)) or told, "a velocity")
    assert set(told) == {0.1}
    wheels.close()


def test_the_check_says_whether_the_gate_is_there(graph, gated, walker):
    def check():
        said = graph.skytether("robot", "run", str(gated), "--check", stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        found, told = (text.decode() for text in said.communicate(timeout=60))
        return said.returncode, found + told

    status, text = check()
    assert status == 0, text
    assert "does not run yet" in " ".join(text.split())


def test_a_gate_alone_names_who_else_publishes_the_wheels_topic(graph, gated, walker, tmp_path):
    graph.skytether("robot", "gate", str(gated))
    other = graph.start("rostopic", "pub", "-r", "5", "/cmd_vel", "geometry_msgs/Twist", "{}")

    def named():
        try:
            troubles = ask(tmp_path / "gate", {"do": "status"}, timeout=30)["troubles"]
        except GateError:  # it is being started
            return False
        return any("/rostopic" in trouble and "publishes /cmd_vel" in trouble for trouble in troubles)

    wait_for(named, "the other publisher is named")
    other.terminate()
    wait_for(lambda: not named(), "it is gone")


def test_of_a_name_that_was_there_twice_nobody_knows_whether_the_other_one_has_the_same(graph, monkeypatch):
    """An old node of the wheels' name was left with one of gate and writer, and stood for the new one at the other."""
    nodes, start = [], Node.start
    monkeypatch.setattr(Node, "start", lambda node: (nodes.append(node), start(node)))
    wheels = Ros1Wheels(Ros1Way(master=graph.uri, cmd_vel="/told"), "guard", WheelsTiming(0.1, 0.1, 0.1, 1.0))
    address = urlsplit(nodes[0].rosrpc)

    def hearers(count):
        wait_for(lambda: len(nodes[0].connections()) == count, "the connections")
        wheels.listeners()
        return wheels.hearers()

    def connect():
        connection = socket.create_connection((address.hostname, address.port))
        connection.sendall(pack_header({"callerid": "/base", "topic": "/told", "type": "*", "md5sum": "*"}))
        return connection

    with closing(wheels), connect():
        assert hearers(1) == {"/base"}
        with connect():
            assert "/base" not in hearers(2)
        assert "/base" not in hearers(1), "which of both has left?"
        assert len(hearers(1)) == 1
