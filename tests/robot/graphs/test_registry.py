"""A kind of robot graph that is one file and its registration drives a whole robot: agent, gate, display, --check."""

import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import closing
from pathlib import Path

import pytest
import yaml

from skytether.api.client import Client
from skytether.api.manifest import Manifest
from skytether.api.rest import RobotCreate, SiteCreate
from skytether.lab.embedded import EmbeddedOrchestrator
from skytether.messages import LaserScan, MarkerArray, Twist, decode, encode
from skytether.robot.config.robot_config import RobotConfig
from skytether.robot.graphs.registry import GRAPHS, keys
from skytether.robot.safety.client import GateError, ask
from skytether.robot.safety.config.safety_config import SafetyConfig

ROOT = Path(__file__).parents[3]
PATIENCE_S = 30.0
FREE = LaserScan(angle_min=-3.0, angle_increment=0.03, range_max=10.0, ranges=[5.0] * 201)
NEAR = LaserScan(angle_min=-3.0, angle_increment=0.03, range_max=10.0, ranges=[0.36] * 201)


def test_each_kind_has_its_key_in_both_sections():
    assert set(GRAPHS) == {"ros1", "ros2"}
    assert keys() == "ros1 or ros2"
    for key, kind in GRAPHS.items():
        assert kind.key == key
        assert RobotConfig.model_fields[key].annotation == kind.section | None
        assert SafetyConfig.model_fields[key].annotation == kind.gate_section | None


class Robot:
    """The hub, and on it the robot: a laser that sees, wheels that remember."""

    def __init__(self) -> None:
        self.scan = FREE
        self.told: list[float] = []
        self.markers = 0
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(0.05)
        self.port = self._socket.getsockname()[1]
        self._asked: dict[bytes, set] = {}
        self._ended = threading.Event()
        self._threads = [threading.Thread(target=self._hand_on), threading.Thread(target=self._look)]
        for thread in self._threads:
            thread.start()

    @property
    def speed(self) -> float:
        return self.told[-1] if self.told else 0.0

    def _hand_on(self) -> None:
        while not self._ended.is_set():
            try:
                data, sender = self._socket.recvfrom(65_536)
            except (TimeoutError, ConnectionRefusedError):
                continue
            if data[:1] == b"+":
                self._asked.setdefault(data[1:], set()).add(sender)
                continue
            topic, _, payload = data.partition(b"\0")
            if topic == b"/walker/cmd_vel":
                self.told.append(decode(Twist, payload).linear.x)
            elif topic == b"/walker/gate_display":
                self.markers += len(decode(MarkerArray, payload).markers)

    def _look(self) -> None:
        while not self._ended.wait(0.05):
            for asked in tuple(self._asked.get(b"/walker/scan", ())):
                self._socket.sendto(b"/walker/scan\0" + encode(self.scan), asked)

    def close(self) -> None:
        self._ended.set()
        for thread in self._threads:
            thread.join()
        self._socket.close()


def wait(condition, what, log):
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, f"waited in vain until {what}:\n{log.read_text()}"
        time.sleep(0.02)


@pytest.fixture
def environment(tmp_path, monkeypatch):
    """The kind is installed as another distribution's: one module and its entry point."""
    site = tmp_path / "site"
    about = site / "hub_graph-1.dist-info"
    about.mkdir(parents=True)
    shutil.copy(Path(__file__).with_name("hub_graph.py"), site)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: hub-graph\nVersion: 1\n")
    points = "hub = hub_graph:Hub\nbroken = hub_graph:Nothing\n"
    (about / "entry_points.txt").write_text(f"[skytether.graphs]\n{points}")
    return {
        "PATH": os.environ["PATH"],
        "HOME": str(tmp_path),
        "PYTHONPATH": os.pathsep.join([str(site), *sys.path]),
    }


def skytether(*words, environment, **options):
    command = [sys.executable, "-m", "skytether.cli", *map(str, words)]
    return subprocess.Popen(command, env=environment, stdin=subprocess.DEVNULL, **options)


@pytest.mark.slow
def test_a_kind_that_is_one_file_and_its_registration_drives_a_robot_with_its_gate(tmp_path, environment):
    log = tmp_path / "log"
    (tmp_path / "orchestrator").mkdir()
    with (
        closing(Robot()) as robot,
        EmbeddedOrchestrator(tmp_path / "orchestrator") as orchestrator,
        Client(orchestrator.url, orchestrator.operator_token) as client,
        log.open("wb") as output,
    ):
        path = [str(ROOT / folder) for folder in ("platform", "services", "docs/examples")]
        client.create_site(SiteCreate(name="here", tier="edge", runtime="process", options={"python_path": path}))
        client.delete_site("local")
        manifest = yaml.safe_load((ROOT / "docs" / "examples" / "wall_stop" / "service.yaml").read_text())
        manifest["spec"]["needs"] = {"cpu": 0.1}
        client.put_service("wall-stop", Manifest.model_validate(manifest))
        token = tmp_path / "token"
        token.touch(0o600)
        token.write_text(client.create_robot(RobotCreate(name="walker")).token)
        gate = tmp_path / "gate"
        document = {
            "robot": "walker",
            "orchestrator": orchestrator.url,
            "token_file": "token",
            "service": "wall-stop",
            "status_port": None,
            "hub": {"port": robot.port},
            "limits": {"max_gap_s": 0.5},
            "safety": {
                "folder": str(gate),
                "footprint": {"radius": 0.3},
                "sensors": {"scan": {"max_age_s": 1.0}},
                "unseen": {"action": "free"},
                "guard_s": 0.5,
                "display": {},
            },
        }
        config = tmp_path / "robot.yaml"
        config.write_text(yaml.safe_dump(document))
        looked = skytether("robot", "run", config, "--check", environment=environment, stdout=subprocess.PIPE)
        assert b"is looked at by the check" in looked.communicate(timeout=PATIENCE_S)[0]
        assert looked.returncode == 0
        agent = skytether("robot", "run", config, environment=environment, stdout=output, stderr=output)
        try:

            def let_go() -> bool:
                try:
                    ask(gate, {"do": "reset"}, PATIENCE_S)
                    return "agent" in ask(gate, {"do": "start"}, PATIENCE_S)["started"]
                except GateError:  # it comes up
                    return False

            wait(let_go, "the agent may drive", log)
            wait(lambda: robot.speed > 0.15, "the service drives", log)
            assert f"/walker/cmd_vel of the hub at {robot.port}" == ask(gate, {"do": "status"}, PATIENCE_S)["wheels"]
            wait(lambda: robot.markers, "the gate is shown", log)
            robot.scan = NEAR
            wait(lambda: ask(gate, {"do": "status"}, PATIENCE_S)["zone"] == "stop", "the gate sees the wall", log)
            wait(lambda: robot.speed == 0.0, "the gate and the service stop before the wall", log)
            robot.scan = FREE
            wait(lambda: robot.speed > 0.15, "it drives on", log)
        finally:
            agent.send_signal(signal.SIGINT)
            agent.wait(PATIENCE_S)
        wait(lambda: robot.speed == 0.0, "the last word is a standstill", log)


@pytest.mark.slow
def test_a_kind_that_cannot_be_loaded_stops_only_the_file_that_names_it(tmp_path, environment):
    config = tmp_path / "robot.yaml"
    text = "robot: walker\norchestrator: https://cloud:8600\ntoken_file: token\nservice: s\n"
    for section, said in (
        ("broken: {}", "has no attribute 'Nothing'"),
        ("hub: {port: 7000}", "cannot read token_file"),
    ):
        config.write_text(text + section)
        refused = skytether("robot", "run", config, "--check", environment=environment, stderr=subprocess.PIPE)
        assert said in " ".join(refused.communicate(timeout=PATIENCE_S)[1].decode().split())
        assert refused.returncode == 2
