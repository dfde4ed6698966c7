import base64
import json
import os
import signal
import socket
import stat
import subprocess
import sys
import threading
from typing import Any

import pytest
import typer
import yaml
from ros2_graph import shared_router, stage
from typer.testing import CliRunner

from skytether.api.manifest import TopicSpec
from skytether.bridge import Bridge, GraphPort, LocalGraph, SessionSpec, topics_from_api
from skytether.cli.commands.bridge.bridge import bridge
from skytether.messages import LaserScan, encode, hash_of
from skytether.wire.topic import Role

__all__ = ["shared_router", "stage"]

app = typer.Typer()
app.command()(bridge)

TOPICS = [
    {"name": "scan", "type": "sensor_msgs/msg/LaserScan", "direction": "in", "priority": 50, "depth": 100},
    {"name": "cmd_vel", "type": "geometry_msgs/msg/Twist", "direction": "out", "priority": 127},
]
BOTH = {
    "role": "both",
    "id": "00000000000000ff",
    "key_file": "bridge.key",
    "topics": TOPICS,
    "sources": [{"topic": "scan", "size": 2222, "rate_hz": 100}, {"topic": "cmd_vel", "size": 80, "rate_hz": 50}],
}


@pytest.fixture
def run(tmp_path):
    """Runs the command in a folder with a key; returns its result."""
    key = tmp_path / "bridge.key"
    key.write_bytes(base64.b64encode(bytes(32)))
    key.chmod(0o600)
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def invoke(document, *options, text=None):
        path = tmp_path / "bridge.yaml"
        path.write_text(text if text is not None else yaml.safe_dump(document))
        return CliRunner().invoke(app, ["--config", str(path), *options])

    yield invoke
    for number, handler in handlers.items():
        signal.signal(number, handler)


@pytest.mark.slow
def test_both_ends_in_one_process_measure_each_other(run):
    result = run(BOTH | {"link": {"up": {"delay_ms": 20}, "down": {"delay_ms": 10}}}, "--seconds", "1.2", "--json")
    assert result.exit_code == 0, result.output
    documents = [json.loads(line) for line in result.stdout.splitlines()]
    assert [(d["end"], d["connected"]) for d in documents] == [("service", True), ("robot", True)] * 2
    service = {t["topic"]: t for t in documents[-2]["topics"]}
    robot = {t["topic"]: t for t in documents[-1]["topics"]}
    assert service["scan"]["delivered"] > 50
    assert service["scan"]["bytes_delivered"] == 2222 * service["scan"]["delivered"]
    assert robot["cmd_vel"]["delivered"] > 25
    assert documents[-1]["paths"][0]["rtt_min"] > 0.03


def test_people_get_a_table(run):
    result = run(BOTH, "--seconds", "0.5")
    assert result.exit_code == 0, result.output
    assert "cmd_vel" in result.stderr
    assert not result.stdout


@pytest.mark.slow
def test_two_processes_join_and_end_on_a_signal(tmp_path):
    key = tmp_path / "bridge.key"
    ends: dict[str, dict[str, Any]] = {
        "service": {"role": "service", "sources": BOTH["sources"][1:]},
        "robot": {"role": "robot", "sources": BOTH["sources"][:1]},
    }
    started = {}
    code = "import typer; from skytether.cli.commands.bridge.bridge import bridge; typer.run(bridge)"
    try:
        subprocess.run([sys.executable, "-c", code, "--new-key", str(key)], check=True, timeout=20)
        for role, own in ends.items():
            if role == "robot":
                port = int(started["service"].stderr.readline().rsplit(":", 1)[1])
                own["peer"] = {"host": "127.0.0.1", "port": port}
            path = tmp_path / f"{role}.yaml"
            path.write_text(yaml.safe_dump(BOTH | own))
            started[role] = subprocess.Popen(
                [sys.executable, "-c", code, "--config", str(path), "--json"],
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
            )
        for process in started.values():
            while not json.loads(process.stdout.readline())["connected"]:
                pass
        started["robot"].send_signal(signal.SIGINT)
        started["service"].terminate()
        outcomes = {role: process.communicate(timeout=10) for role, process in started.items()}
        assert {role: p.returncode for role, p in started.items()} == {"service": 0, "robot": 0}, outcomes
        last = json.loads(outcomes["service"][0].splitlines()[-1])
        assert next(t for t in last["topics"] if t["topic"] == "scan")["delivered"] > 0
    finally:
        for process in started.values():
            if process.poll() is None:
                process.kill()
                process.communicate()


def without(key):
    return {k: v for k, v in BOTH.items() if k != key}


@pytest.mark.parametrize(
    ("document", "says"),
    [
        (BOTH | {"rol": "robot"}, "rol: unknown key, did you mean 'role'?"),
        (BOTH | {"role": "cloud"}, "role: input should be 'robot', 'service' or 'both'"),
        (without("id"), "id: is missing"),
        (BOTH | {"id": "12"}, "id: string should match"),
        (BOTH | {"topics": []}, "topics: "),
        (BOTH | {"topics": [TOPICS[0] | {"prority": 3}]}, "topics.0.prority: unknown key, did you mean 'priority'?"),
        (
            BOTH | {"topics": [TOPICS[0] | {"priority": 128}]},
            "topics.0.priority: input should be less than or equal to 127",
        ),
        (BOTH | {"topics": [TOPICS[0]] * 2, "sources": []}, "topics: 'scan' is listed twice"),
        (
            BOTH | {"sources": [{"topic": "x", "size": 1, "rate_hz": 1}]},
            "sources.0.topic: 'x' is not sent by role 'both'",
        ),
        (BOTH | {"role": "robot"}, "peer: role 'robot' needs the host and port"),
        (
            BOTH | {"role": "robot", "peer": {"port": 5}},
            "sources.1.topic: 'cmd_vel' is not sent by role 'robot'; it may be one of: scan",
        ),
        (BOTH | {"peer": {"port": 5}}, "peer: only role 'robot' has one"),
        (BOTH | {"role": "service", "sources": [], "link": {}}, "link: only role 'both'"),
        (BOTH | {"link": {"up": {"dellay_ms": 5}}}, "link.up.dellay_ms: unknown key, did you mean 'delay_ms'?"),
        (BOTH | {"link": {"up": {"loss": 0.9, "burst": 4}}}, "link: loss must be 0 to 0.8 with bursts of 4"),
        (BOTH | {"bind": {"port": 70_000}}, "bind.port: input should be less than or equal to 65535"),
        (BOTH | {"key_file": "none.key"}, "none.key: No such file or directory; make one with"),
    ],
)
def test_a_mistake_is_named_by_its_key_with_what_is_allowed(run, document, says):
    result = run(document)
    assert result.exit_code == 2
    assert says in result.stderr
    assert "Traceback" not in result.output


def test_a_key_that_comes_twice_and_a_second_document_are_refused(run):
    for text, says in (
        ("id: a\nrole: robot\nid: b\n", "in line 3: the key 'id' comes twice"),
        ("role: robot\n---\nrole: service\n", "holds 2 documents; a configuration is one"),
    ):
        result = run(None, text=text)
        assert result.exit_code == 2
        assert says in " ".join(result.stderr.split())


@pytest.mark.parametrize("text", ["", "- a\n- b", "a: [1", "\x00"])
def test_what_is_no_configuration_is_refused(run, text):
    result = run(None, text=text)
    assert result.exit_code == 2
    assert "bridge.yaml" in result.stderr


def test_no_option_says_which_are_needed(run):
    result = CliRunner().invoke(app, [])
    assert result.exit_code == 2
    assert "--config" in result.stderr
    result = CliRunner().invoke(app, ["--config", "/no/such/file"])
    assert result.exit_code == 2
    assert "cannot read /no/such/file: No such file" in result.stderr


def test_a_key_that_others_can_read_is_refused(run, tmp_path):
    (tmp_path / "bridge.key").chmod(0o640)
    result = run(BOTH)
    assert result.exit_code == 2
    assert "chmod 600" in result.stderr


def test_a_key_file_without_a_key_is_refused_and_not_shown(run, tmp_path):
    (tmp_path / "bridge.key").write_text("my password")
    result = run(BOTH)
    assert result.exit_code == 2
    assert "holds no key of 32 bytes" in result.stderr
    assert "password" not in result.output


def test_a_taken_port_is_one_sentence(run):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        result = run(BOTH | {"bind": {"port": port}})
    assert result.exit_code == 1
    assert f"cannot listen on UDP 127.0.0.1:{port}: Address already in use" in result.stderr


def test_a_peer_that_does_not_answer_is_an_error_in_the_end(run):
    result = run(BOTH | {"role": "robot", "peer": {"port": 9}, "sources": []}, "--seconds", "0.2")
    assert result.exit_code == 1
    assert "robot: no session came up" in result.stderr


def test_a_new_key_is_readable_by_its_owner_only_and_never_overwritten(tmp_path):
    path = tmp_path / "new.key"
    result = CliRunner().invoke(app, ["--new-key", str(path)])
    assert result.exit_code == 0
    assert stat.S_IMODE(os.stat(path).st_mode) == 0o600
    key = path.read_text()
    assert len(base64.b64decode(key)) == 32
    assert key.strip() not in result.output
    result = CliRunner().invoke(app, ["--new-key", str(path)])
    assert result.exit_code == 2
    assert "exists already" in result.stderr
    assert path.read_text() == key


def ros2_end(**ros2):
    return {k: v for k, v in BOTH.items() if k != "sources"} | {
        "role": "service",
        "ros2": {"dialect": "rmw_zenoh"} | ros2,
    }


def ros1_end(**ros1):
    return {k: v for k, v in BOTH.items() if k != "sources"} | {"role": "service", "ros1": ros1}


@pytest.mark.parametrize(
    ("document", "text"),
    [
        (BOTH | {"ros2": {}}, "ros2: is for role 'robot' or 'service', and without sources"),
        (ros2_end(router="127.0.0.1"), "ros2.router"),
        (ros2_end(domain=300), "ros2.domain"),
        (ros2_end(dialect="rclpy", router="tcp/127.0.0.1:1"), "ros2: router: is for a graph with a Zenoh router"),
        (ros2_end(python="python3"), "ros2: python: is for dialect: rclpy, and this one is rmw_zenoh"),
        (ros2_end(dialect="rclpy", python="no-such"), "ros2: no Python with ROS 2 is here (no-such: there is no such"),
        (ros2_end(dialekt="x"), "ros2.dialekt: unknown key, did you mean 'dialect'?"),
        (ros2_end(namespace="/3po"), "ros2: namespace: '/3po' is not a valid name of a ROS 2 graph"),
        (ros2_end(remap={"skan": "/scan"}), "ros2.remap.skan: there is no such topic or call"),
        (ros2_end(zenoh_config="none.json5"), "ros2: Zenoh does not take the configuration"),
        (ros2_end() | {"ros1": {}}, "ros1, ros2: the graph at this end is one of the two"),
        (BOTH | {"ros1": {}}, "ros1: is for role 'robot' or 'service', and without sources"),
        (ros1_end(master="localhost:11311"), "ros1.master: must be an address such as http://localhost:11311"),
        (ros1_end(namespace="3po"), "ros1: namespace: '3po' is not a valid name of a graph"),
        (ros1_end(node="a b"), "ros1: node: 'a b' is not a valid name of a graph"),
        (ros1_end(remap={"skan": "/scan"}), "ros1.remap.skan: there is no such topic or call"),
        (ros2_end() | {"topics": [{"name": "a", "type": "Twist", "direction": "in"}]}, "topic 'a': 'Twist' is no type"),
    ],
)
def test_an_end_of_ros_that_cannot_be_is_named(run, document, text):
    result = run(document, "--seconds", "0.1")
    assert result.exit_code == 2, result.output
    assert text in result.output


def test_the_extra_is_named_where_it_is_missing(run, monkeypatch):
    monkeypatch.setitem(sys.modules, "zenoh", None)
    result = run(ros2_end(), "--seconds", "0.1")
    assert result.exit_code == 2
    assert "a ROS 2 graph with a Zenoh router needs the extra 'ros2': pip install 'skytether[ros2]'" in result.output


@pytest.mark.slow
def test_an_end_is_a_ros2_graph(run, stage):
    """A service's end with a ROS 2 graph, and a robot's end that sends made-up messages to it."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as found:
        found.bind(("127.0.0.1", 0))
        port = found.getsockname()[1]
    rihs = hash_of("sensor_msgs/msg/LaserScan", "cdr")
    scans = stage.rmw("listener").subscribe("/bot/scan", "sensor_msgs::msg::dds_::LaserScan_", rihs)
    scan = LaserScan(ranges=[1.0] * 10)
    topics = topics_from_api(TopicSpec(**row) for row in TOPICS)
    graph = LocalGraph()
    spec = SessionSpec(0xFF, bytes(32), Role.ROBOT, topics)
    robot = Bridge(spec, GraphPort(graph, topics, Role.ROBOT), peer=("127.0.0.1", port))
    done = threading.Event()

    def publish():
        while not done.wait(0.05):
            robot.publish("scan", encode(scan, "cdr"))
            if scans.samples:
                os.kill(os.getpid(), signal.SIGINT)  # as Ctrl-C
                return

    publishing = threading.Thread(target=publish)
    with robot:
        publishing.start()
        ros2 = {"router": stage.router.address, "domain": stage.domain, "namespace": "/bot"}
        result = run(ros2_end(**ros2) | {"bind": {"host": "127.0.0.1", "port": port}}, "--seconds", "60", "--json")
        done.set()
        publishing.join()
    assert result.exit_code == 0, result.output
    assert scans.payloads[0] == encode(scan, "cdr")
