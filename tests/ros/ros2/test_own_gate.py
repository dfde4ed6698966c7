"""``skytether robot run`` on a ROS 2 graph, with the gate that it starts, and somebody else at the wheels."""

import os
import signal
import subprocess
import sys
import threading

import psutil
import pytest
import yaml
from gate_robot import forget_stops

from skytether.messages import Header, Time, Twist, Vector3, Wrench, WrenchStamped, decode, encode, type_hash
from skytether.robot.safety.client import listens

pytestmark = pytest.mark.slow

DDS_TWIST = "geometry_msgs::msg::dds_::Twist_"


@pytest.fixture
def start(stage, tmp_path, monkeypatch):
    """Starts ``robot run`` with the robot's own controller, which follows a push; there is no orchestrator."""
    started = []
    token = tmp_path / "walker.token"
    token.touch(0o600)
    token.write_text("secret")

    def start(**more):
        document = {
            "robot": "walker",
            "orchestrator": "http://127.0.0.1:9",
            "token_file": "walker.token",
            "service": "wall-stop",
            "fallback": {"name": "admittance"},
            "status_port": None,
            "limits": {"max_gap_s": 0.3, "max_local_age_s": 1.0},
            "ros2": {
                "dialect": "rmw_zenoh",
                "router": stage.router.address,
                "domain": stage.domain,
                "namespace": "/",
                "readings": {"force": "geometry_msgs/msg/WrenchStamped"},
            },
            **more,
        }
        path = tmp_path / "robot.yaml"
        path.write_text(yaml.safe_dump(document))
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        environment["SKYTETHER_GATE_FOLDER"] = str(tmp_path / "gate")
        with (tmp_path / "log").open("ab") as log:
            command = [sys.executable, "-m", "skytether.cli", "robot", "run", str(path)]
            started.append(subprocess.Popen(command, env=environment, stdout=log, stderr=log))
        return started[-1]

    start.folder, start.log = tmp_path / "gate", tmp_path / "log"
    forget_stops(start.folder, monkeypatch)
    yield start
    for process in started:
        process.kill()
        process.wait()


class Push:
    """Somebody pushes the walker, twenty times a second."""

    def __init__(self, publish):
        self._publish = publish
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._ended.set()
        self._thread.join()

    def _run(self):
        while not self._ended.wait(0.05):
            self._publish(encode(WrenchStamped(Header(Time(1), "handle"), Wrench(Vector3(x=30.0))), "cdr"))


def test_a_gate_of_its_own_stops_the_wheels_when_the_agent_is_killed(stage, start):
    base = stage.rmw("base")
    wheels = base.subscribe("/cmd_vel", DDS_TWIST, type_hash(Twist, "cdr"))
    kind = "geometry_msgs::msg::dds_::WrenchStamped_"
    push = base.publisher("/force", kind, type_hash(WrenchStamped, "cdr"))

    def speed():
        return decode(Twist, wheels.payloads[-1]).linear.x if wheels.samples else 0.0

    agent = start()
    stage.until(lambda: listens(start.folder), "no gate")
    stage.until(lambda: wheels.samples, "the wheels are told nothing")
    with Push(push):
        stage.until(lambda: speed() > 0.1, "the robot does not drive")
        gate = psutil.Process(agent.pid).children(recursive=True)
        agent.send_signal(signal.SIGKILL)
        stage.until(lambda: speed() == 0.0, "the robot drives on")
        assert psutil.wait_procs(gate, timeout=30)[1] == []
    assert speed() == 0.0
    assert "publishes /cmd_vel too" not in start.log.read_text()


@pytest.mark.parametrize("safety", ["none", {"footprint": {"radius": 0.3}, "sensors": {}}])
def test_who_else_publishes_the_wheels_topic_is_named(stage, start, safety):
    base = stage.rmw("base")
    start(safety=safety)
    stage.until(lambda: base.sees("MP", "/cmd_vel"), "nobody publishes the wheels' topic")
    stage.rmw("teleop").publisher("/cmd_vel", DDS_TWIST, type_hash(Twist, "cdr"))
    watchers = 1 if safety == "none" else 2  # the agent, and a gate too

    def named():
        return start.log.read_text().count("/teleop publishes /cmd_vel too")

    stage.until(lambda: named() >= watchers, "the other one is not named")
    assert named() == watchers  # once by each
