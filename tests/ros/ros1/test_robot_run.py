"""``skytether robot run`` on a real master, with a real orchestrator and a service."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from ros1_graph import wait_for

from skytether.messages import LaserScan, Twist, decode, type_hash
from skytether.ros.ros1.node import Node
from skytether.ros.ros1.subscription import Listener

pytestmark = [pytest.mark.ros1, pytest.mark.slow]

SCAN_MD5 = type_hash(LaserScan, "ros1")


def test_a_service_drives_a_robot_of_ros_1_and_stops_it_where_the_laser_knows_nothing(graph, config, walker, tmp_path):
    process = graph.skytether("robot", "run", str(config), stderr=subprocess.PIPE)
    wait_for(lambda: walker.speed is not None and abs(walker.speed - 0.2) < 1e-9, "the service to drive")
    assert "/skytether" in graph.ask("rosnode", "list").split()
    walker.scan = LaserScan(angle_min=-1.0, angle_increment=0.01, range_max=10.0)
    wait_for(lambda: walker.speed == 0.0, "the standstill before a laser without ranges")
    walker.scan = LaserScan(angle_min=-1.0, angle_increment=0.01, range_max=10.0, ranges=[0.0] * 200)
    time.sleep(0.5)
    assert walker.speed == 0.0
    walker.scan = LaserScan(angle_min=-1.0, angle_increment=0.01, range_max=10.0, ranges=[3.0] * 200)
    wait_for(lambda: walker.speed and walker.speed > 0.1, "the service to drive again")
    # As a ROS user ends nodes; the wheels' last word is a standstill, and the node is gone from the graph.
    graph.ask("rosnode", "kill", "/skytether")
    said = process.stderr.read().decode()
    assert process.wait(30) == 0, said
    wait_for(lambda: walker.speed == 0.0, "the last standstill")
    wait_for(lambda: graph.publishers("/cmd_vel") == [], "the node to be gone from the graph")
    assert "driving: cloud" in said
    assert "Traceback" not in said


def test_a_laser_of_another_type_drives_nobody_and_the_check_says_so_before(graph, config, tmp_path):
    with Node("walker", graph.uri, look_s=0.2) as node:
        told = []
        node.subscribe("/cmd_vel", "*", "", Listener(lambda data, _: told.append(decode(Twist, data, "ros1").linear.x)))
        laser = node.advertise("/scan", "std_msgs/Bool", "8b94c1b53db61fb6aed406028ad6332a", latched=True)
        laser.publish(b"\x01")
        checked = graph.skytether(
            "robot", "run", str(config), "--check", stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
        found, said = (text.decode() for text in checked.communicate(timeout=60))
        assert checked.returncode == 1, found + said
        (row,) = [line for line in found.splitlines() if line.startswith("!!")]
        assert SCAN_MD5 in row, "in a pipe a row is one line, however long"
        assert "1 to mend" in said
        doctor = graph.skytether("doctor", str(config), "--json", stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        found, said = (text.decode() for text in doctor.communicate(timeout=60))
        assert doctor.returncode == 1, found + said
        findings = {finding["check"]: finding for finding in json.loads(found)}
        assert "publishes std_msgs/Bool with MD5" in findings["types"]["says"]
        assert {check: f["state"] for check, f in findings.items() if check != "types"} == dict.fromkeys(
            ("extras", "fallback", "orchestrator", "clock", "token", "udp", "mtu", "nat", "ros master"), "ok"
        )
        process = graph.skytether("robot", "run", str(config))
        log = graph.folder / f"{Path(sys.executable).name}.log"
        wait_for(lambda: "publishes std_msgs/Bool" in log.read_text(), "the refusal")
        time.sleep(1.0)  # once, and not again
        process.send_signal(signal.SIGINT)
        process.wait(30)
        said = log.read_text()
    assert said.count("publishes std_msgs/Bool with MD5 8b94c1b53db61fb6aed406028ad6332a") == 1
    assert SCAN_MD5 in said
    assert set(told) <= {0.0}


def test_the_check_finds_all_that_is_there(graph, config, walker):
    said = graph.skytether("robot", "run", str(config), "--check", stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    found, told = (text.decode() for text in said.communicate(timeout=60))
    assert said.returncode == 0, found + told
    assert "all is there" in told
    assert "from /walker" in found
    assert "/cmd_vel" in found


def test_without_master_and_orchestrator_it_waits_and_says_so_once_and_the_check_names_both(make_graph, tmp_path):
    graph = make_graph()  # no master
    token = tmp_path / "walker.token"
    token.touch(0o600)
    token.write_text("secret")
    path = tmp_path / "robot.yaml"
    path.write_text(
        f"robot: walker\norchestrator: http://127.0.0.1:9\ntoken_file: walker.token\nservice: wall-stop\nsafety: none\n"
        f"ros1: {{master: '{graph.uri}'}}\n"
    )
    process = graph.skytether("robot", "run", str(path), "--seconds", "6", stderr=subprocess.PIPE)
    said = process.stderr.read().decode()
    assert process.wait(30) == 0, said
    assert said.count("no ROS master answers") == 1
    assert "no orchestrator answers" in said
    check = graph.skytether("robot", "run", str(path), "--check", stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    found, said = (text.decode() for text in check.communicate(timeout=60))
    assert check.returncode == 1
    assert found.count("!!") == 2
