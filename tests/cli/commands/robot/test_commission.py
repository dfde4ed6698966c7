"""`skytether robot commission` as a real process, on simulated drives: with a watchdog and an enable input, or not."""

import json
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from rig_wheels import Drives

from skytether.guard.velocity import Velocity
from skytether.messages import Bool, Twist, Vector3, decode, encode
from skytether.robot.safety.client import stop

pytestmark = pytest.mark.slow

PATIENCE_S = 120.0


class Machine:
    """The drives on the gate's sockets, and a person who answers yes and does what is said."""

    def __init__(self, folder: Path, drives: Drives) -> None:
        self.folder, self.drives = folder, drives
        self.button = False
        self._ended = threading.Event()
        self._wheels, self._power = self._listen("wheels.sock"), self._listen("power.sock")
        self._thread = threading.Thread(target=self._roll)
        self._thread.start()
        section = {
            "footprint": {"radius": 0.3},
            "sensors": {},
            "folder": str(folder),
            "limits": {"linear_max": 0.5, "angular_max": 1.0, "linear_braking": 0.6, "linear_acceleration": 0.5},
            "zones": {"reaction_s": 0.9},
            "odometry": {"type": "geometry_msgs/msg/Twist", "max_age_s": 1.0, "linear_tolerance": 0.02},
            "estop": {"max_age_s": 2.0},
            "enable": {"socket": f"unix:{folder}/power.sock"},
        }
        self.config = folder.parent / "robot.yaml"
        self.config.write_text(yaml.safe_dump({"safety": section}))

    def _listen(self, name: str) -> socket.socket:
        made = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        made.bind(str(self.folder / name))
        made.setblocking(False)
        return made

    def commission(self, *options: str) -> tuple[int, dict, str]:
        command = [sys.executable, "-m", "skytether.cli", "robot", "commission", str(self.config), *options]
        pipe = subprocess.PIPE
        process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True)
        assert process.stdin is not None
        assert process.stdout is not None
        assert process.stderr is not None
        timer = threading.Timer(PATIENCE_S, process.kill)
        timer.start()
        said = []
        with process:
            for line in process.stderr:
                said.append(line)
                if "[y/N]" in line:
                    process.stdin.write("y\n")
                    process.stdin.flush()
                elif line.startswith("now "):
                    self.button = "press" in line.split()
            text = process.stdout.read()
        timer.cancel()
        return process.returncode, json.loads(text) if text else {}, "".join(said)

    def close(self) -> None:
        self._ended.set()
        self._thread.join()
        self._wheels.close()
        self._power.close()

    def _roll(self) -> None:
        last = time.monotonic()
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as link:
            link.setblocking(False)
            while not self._ended.wait(0.01):
                now = time.monotonic()
                for data in _waiting(self._wheels):
                    twist = decode(Twist, data)
                    self.drives.write(Velocity(twist.linear.x, twist.angular.z), now)
                for data in _waiting(self._power):
                    self.drives.enable(bool(decode(Bool, data).data), now)
                self.drives.roll(now, now - last)
                last = now
                linear, angular = self.drives.shown
                odom = encode(Twist(linear=Vector3(x=linear), angular=Vector3(z=angular)))
                self._send(link, "sensors.sock", "odom", odom)
                self._send(link, "estop.sock", "estop", encode(Bool(data=self.button)))

    def _send(self, link: socket.socket, where: str, topic: str, data: bytes) -> None:
        try:
            link.sendto(topic.encode() + b"\0" + data, str(self.folder / where))
        except OSError:  # nobody listens yet, or takes it
            return


def _waiting(source: socket.socket) -> Iterator[bytes]:
    while True:
        try:
            yield source.recv(256)
        except BlockingIOError:
            return


@pytest.fixture
def machine(tmp_path):
    made = []

    def make(drives: Drives) -> Machine:
        folder = tmp_path / "run"
        folder.mkdir()
        made.append(Machine(folder, drives))
        return made[-1]

    yield make
    for machine in made:
        machine.close()


def test_good_drives_pass_and_what_is_to_be_configured_is_told(machine, tmp_path):
    robot = machine(Drives(braking=Velocity(1.0, 2.0), dead_s=0.1, watchdog_s=0.5, enable_s=0.5))
    record = tmp_path / "record.json"
    status, document, said = robot.commission("--record", str(record))
    assert document["ended"] == "", said
    steps = {step["step"]: step for step in document["steps"]}
    assert list(steps) == ["button", "directions", "watchdog", "braking", "turning", "power"]
    assert {name: step["ok"] for name, step in steps.items()} == dict.fromkeys(steps, True), said
    assert (status, document["passed"]) == (0, True)
    # What a busy machine may add is in the bounds; the made-up clock of the other tests has none.
    assert 0.5 <= steps["watchdog"]["stood_after_s"] <= 2.0
    assert document["proposal"].keys() == {"limits.linear_braking", "limits.angular_braking", "zones.reaction_s"}
    assert json.loads(record.read_text()) == document


def test_drives_that_nothing_stops_fail_by_name(machine):
    robot = machine(Drives(watchdog_s=None, turned=Velocity(1.0, -1.0)))
    status, document, said = robot.commission("--only", "directions", "--only", "watchdog", "--only", "power")
    assert status == 1
    assert {step["step"]: step["ok"] for step in document["steps"]} == {
        "directions": False,
        "watchdog": False,
        "power": False,
    }
    assert "need a watchdog" in said
    assert "the wheels turn without the signal" in said


def test_a_robot_whose_gate_runs_that_is_stopped_or_that_cannot_be_measured_is_refused(machine):
    robot = machine(Drives())
    gate = subprocess.Popen(
        [sys.executable, "-m", "skytether.cli", "robot", "gate", str(robot.config)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        end = time.monotonic() + PATIENCE_S
        while not (robot.folder / "stop.sock").exists():
            assert time.monotonic() < end
            time.sleep(0.05)
        status, _, said = robot.commission()
        assert status == 1
        assert "a gate runs in" in said.replace("\n", " ")
        stop(robot.folder, "somebody fell", PATIENCE_S)
    finally:
        gate.terminate()
        gate.wait(PATIENCE_S)
    status, _, said = robot.commission()
    assert status == 1
    assert "the robot is stopped: somebody fell" in said.replace("\n", " ")
    document = yaml.safe_load(robot.config.read_text())
    del document["safety"]["odometry"]
    robot.config.write_text(yaml.safe_dump(document))
    status, _, said = robot.commission()
    assert status == 1
    assert "safety.odometry is not configured" in said
