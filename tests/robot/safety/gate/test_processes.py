"""Guard, gate and agent as real processes, killed and frozen in every way: the wheels stop, each time."""

import json
import math
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import yaml

from skytether.api.client import Client
from skytether.api.rest import GateReport, RobotCreate
from skytether.lab.embedded import EmbeddedOrchestrator
from skytether.messages import Bool, Joy, LaserScan, Message, Twist, Vector3, Wrench, WrenchStamped, decode, encode
from skytether.robot.agent import remote_stop
from skytether.robot.agent.agent import Agent
from skytether.robot.agent.config import AgentConfig
from skytether.robot.agent.gated_hardware import GatedHardware
from skytether.robot.safety.client import GateError, GateLink, ask

pytestmark = pytest.mark.slow

PATIENCE_S = 30.0
HERE = Path(__file__).parent
CONFIG = {
    "footprint": {"radius": 0.3},
    "sensors": {"scan": {"max_age_s": 1.0}},
    "joystick": {"deadman": 0, "linear_axis": 0, "angular_axis": 1, "max_age_s": 1.0},
    "estop": {"max_age_s": 2.0},
    # Wide, for a busy machine: what is told and what is measured may be seconds apart.
    "odometry": {
        "type": "geometry_msgs/msg/Twist",
        "latency_s": 0.5,
        "lag_s": 0.5,
        "confirm_s": 1.0,
        "blocked_s": 1.0,
        "max_age_s": 1.0,
        "on_unknown": "free",
    },
    "guard_s": 0.5,
    "limits": {"max_gap_s": 0.5},
}


class Robot:
    """Hardware in this process: wheels that remember, a laser, a button. Guard and agent beside it."""

    def __init__(self, folder: Path, log: Path) -> None:
        self.folder = folder
        self.wall = 5.0
        self.pad: Joy | None = None
        self.blocked = False
        self.told: list[tuple[float, float]] = []
        self.log = log
        self._ended = threading.Event()
        self._wheels = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._wheels.bind(str(folder / "wheels.sock"))
        self._wheels.settimeout(0.2)
        self.edges: list[float] = []
        self._power = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._power.bind(str(folder / "power.sock"))
        self._power.settimeout(0.2)
        self._threads = [threading.Thread(target=target) for target in (self._turn, self._sense, self._switch)]
        for thread in self._threads:
            thread.start()
        config = folder.parent / "robot.yaml"
        enable = {"socket": f"unix:{folder}/power.sock", "after_s": 0.1}
        config.write_text(yaml.safe_dump({"safety": CONFIG | {"folder": str(folder), "enable": enable}}))
        with log.open("ab") as output:
            self.guard = subprocess.Popen(
                [sys.executable, "-m", "skytether.cli", "robot", "gate", str(config)], stdout=output, stderr=output
            )
        self.agent = self.start_agent()
        wait(self._reset, "the first act is a reset", self)
        self.start()

    def _reset(self) -> bool:
        try:
            ask(self.folder, {"do": "reset"}, timeout=PATIENCE_S)
        except GateError:
            return False
        return True

    def start_agent(self) -> subprocess.Popen[bytes]:
        with self.log.open("ab") as output:
            return subprocess.Popen(
                [sys.executable, str(HERE / "agent_process.py"), str(self.folder)], stdout=output, stderr=output
            )

    def status(self) -> dict:
        return ask(self.folder, {"do": "status"}, timeout=PATIENCE_S)

    def start(self) -> None:
        """A person lets the agent go on: after each start of a gate, each reset and each lost joystick."""

        def started() -> bool:
            try:
                return "agent" in ask(self.folder, {"do": "start"}, PATIENCE_S)["started"]
            except GateError:  # it is being started
                return False

        wait(started, "the agent may drive", self)

    def drives(self) -> None:
        wait(lambda: self.newest()[0] > 0.15, "the robot drives", self)

    def stands(self, seconds: float = 0.5) -> None:
        """It comes to a standstill and stays there, that long at least."""

        def stays() -> bool:
            self.told.clear()
            time.sleep(seconds)
            return set(self.told) == {(0.0, 0.0)}

        wait(lambda: self.newest() == (0.0, 0.0) and (not seconds or stays()), "the robot stands", self)

    def close(self) -> None:
        for process in (self.agent, self.guard):
            process.send_signal(signal.SIGCONT)
            process.terminate()
        for process in (self.agent, self.guard):
            try:
                process.wait(PATIENCE_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self._ended.set()
        for thread in self._threads:
            thread.join()
        self._wheels.close()
        self._power.close()

    def powered(self) -> None:
        """The enable signal changes, again and again."""
        before = len(self.edges)
        wait(lambda: len(self.edges) > before + 10, "the enable signal changes", self)

    def cut(self) -> None:
        """The enable signal is still for longer than any relay waits for it."""

        def still() -> bool:
            before = len(self.edges)
            time.sleep(0.5)
            return len(self.edges) == before

        wait(still, "the enable signal is still", self)

    def newest(self) -> tuple[float, float]:
        return self.told[-1] if self.told else (0.0, 0.0)

    def _turn(self) -> None:
        while not self._ended.is_set():
            try:
                twist = decode(Twist, self._wheels.recv(256))
            except TimeoutError:
                continue
            self.told.append((twist.linear.x, twist.angular.z))

    def _switch(self) -> None:
        level = None
        while not self._ended.is_set():
            try:
                high = decode(Bool, self._power.recv(64)).data
            except TimeoutError:
                continue
            if high is not level:
                level = high
                self.edges.append(time.monotonic())

    def _sense(self) -> None:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as link:
            link.settimeout(0.2)
            while not self._ended.wait(0.04):
                self._send(link, "scan", self._scan())
                self._send(link, "estop", Bool(), "estop.sock")
                linear, angular = (0.0, 0.0) if self.blocked else self.newest()
                self._send(link, "odom", Twist(linear=Vector3(x=linear), angular=Vector3(z=angular)))
                if self.pad is not None:
                    self._send(link, "joy", self.pad)

    def _send(self, link: socket.socket, topic: str, message: Message, where: str = "sensors.sock") -> None:
        try:
            link.sendto(topic.encode() + b"\0" + encode(message), str(self.folder / where))
        except OSError:  # the gate is not there, or does not take it: so much the worse for it
            return

    def _scan(self) -> LaserScan:
        ranges = np.full(181, self.wall, dtype=np.float32)
        return LaserScan(
            angle_min=-math.pi / 2, angle_increment=math.pi / 180, range_min=0.05, range_max=8.0, ranges=ranges
        )


def wait(condition: Callable[[], bool], what: str, robot: Robot | None = None) -> None:
    end = time.monotonic() + PATIENCE_S
    while not condition():
        if time.monotonic() > end:
            log = robot.log.read_text() if robot else ""
            pytest.fail(f"not within {PATIENCE_S} s: {what}\n{log}")
        time.sleep(0.02)


def reported(operator: Client) -> GateReport:
    """What the orchestrator knows of the first robot's gate."""
    return operator.robots()[0].gate or GateReport()


def fill(path: Path) -> None:
    """Write until nothing more goes on the disk."""
    with path.open("wb", buffering=0) as file:
        while True:
            file.write(bytes(4096))


def gate_pid(robot: Robot, other_than: int = 0) -> int:
    """The gate's process id, as soon as there is one that answers."""

    def found() -> int:
        try:
            pid = int(robot.status()["pid"])
        except GateError:
            return 0
        return 0 if pid == other_than else pid

    wait(lambda: found() != 0, "the gate answers", robot)
    return int(robot.status()["pid"])


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[Robot]:
    folder = tmp_path / "run"
    folder.mkdir()
    robot = Robot(folder, tmp_path / "log")
    yield robot
    robot.close()


def test_the_agent_killed_or_frozen(robot):
    robot.drives()
    robot.agent.send_signal(signal.SIGSTOP)
    robot.stands()
    robot.agent.send_signal(signal.SIGCONT)
    robot.drives()
    robot.agent.kill()
    robot.agent.wait()
    robot.stands()
    robot.agent = robot.start_agent()
    robot.drives()
    said = robot.log.read_text().count("the last valid command is too old")
    assert said <= 2  # once each time, not fifty times a second


def test_the_gate_killed_or_frozen(robot):
    robot.drives()
    first = gate_pid(robot)
    os.kill(first, signal.SIGKILL)
    robot.stands(0.0)
    second = gate_pid(robot, other_than=first)
    robot.start()
    robot.drives()
    os.kill(second, signal.SIGSTOP)
    robot.stands(0.0)
    third = gate_pid(robot, other_than=second)  # a frozen one is ended and started anew
    robot.stands()  # nothing moves by itself
    assert "agent" in robot.status()["waiting"]
    robot.start()
    robot.drives()
    ask(robot.folder, {"do": "stop", "reason": "a test"}, PATIENCE_S)
    assert "a test" in (robot.folder / "latch").read_text()
    robot.stands()
    os.kill(third, signal.SIGKILL)
    gate_pid(robot, other_than=third)
    robot.stands()
    assert "a test" in robot.status()["stopped"]
    ask(robot.folder, {"do": "reset"}, PATIENCE_S)
    robot.stands()  # nothing moves by itself
    robot.start()
    robot.drives()


def test_the_guard_frozen_or_killed(robot):
    robot.drives()
    gate = gate_pid(robot)
    robot.guard.send_signal(signal.SIGSTOP)
    robot.stands()
    robot.guard.send_signal(signal.SIGCONT)
    robot.drives()
    robot.guard.kill()
    robot.guard.wait()
    robot.stands()
    wait(lambda: not _alive(gate), "the gate ends without its guard", robot)


def test_a_gate_that_is_started_without_standard_descriptors_is_ready(tmp_path):
    (tmp_path / "run").mkdir()
    config = tmp_path / "robot.yaml"
    config.write_text(yaml.safe_dump({"safety": CONFIG | {"folder": str(tmp_path / "run")}}))
    start = [sys.executable, "-m", "skytether.cli", "robot", "gate", str(config)]
    guard = subprocess.Popen(["sh", "-c", 'exec "$@" 0<&- 1>&- 2>&-', "sh", *start])

    def answers() -> bool:
        try:
            return bool(ask(tmp_path / "run", {"do": "status"}, PATIENCE_S))
        except GateError:
            return False

    try:
        wait(answers, "the gate answers")
        assert [os.readlink(f"/proc/{guard.pid}/fd/{number}") for number in range(3)] == ["/dev/null"] * 3
        assert b"INFO" not in (tmp_path / "run/lock").read_bytes()
    finally:
        guard.terminate()
        guard.wait(PATIENCE_S)


def test_the_disk_is_full(tmp_path, netns):
    disk = tmp_path / "disk"
    disk.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=4m", "tmpfs", str(disk)], check=True)
    try:
        folder = disk / "run"
        folder.mkdir()
        robot = Robot(folder, disk / "log")
        try:
            robot.drives()
            with pytest.raises(OSError, match="No space left"):
                fill(disk / "fill")
            robot.drives()
            ask(folder, {"do": "stop", "reason": "full"}, PATIENCE_S)
            assert "full" in (folder / "latch").read_text()  # on a full disk, too
            robot.stands()
            first = gate_pid(robot)
            os.kill(first, signal.SIGKILL)
            gate_pid(robot, other_than=first)
            robot.stands()
            ask(folder, {"do": "reset"}, PATIENCE_S)
            robot.start()
            robot.drives()
            robot.agent.kill()
            robot.stands()
        finally:
            robot.close()
    finally:
        subprocess.run(["umount", "-l", str(disk)], check=True)


def test_people_and_things_in_the_way(robot):
    up = Joy(axes=np.zeros(2, dtype=np.float32), buttons=np.zeros(1, dtype=np.int32))
    robot.pad = up
    robot.drives()
    robot.wall = 0.38
    robot.stands()
    assert robot.status()["zone"] == "stop"
    robot.wall = 5.0
    robot.drives()
    robot.drives()
    robot.pad = Joy(axes=np.array([0.0, 1.0], dtype=np.float32), buttons=np.array([1], dtype=np.int32))
    wait(lambda: robot.newest() == pytest.approx((0.0, 0.4)), "the joystick turns the robot", robot)
    robot.pad = up
    robot.drives()  # the button was let go: the agent goes on
    robot.pad = Joy(axes=np.array([0.0, 1.0], dtype=np.float32), buttons=np.array([1], dtype=np.int32))
    robot.stands()  # its driver repeats itself as if the radio were gone
    assert "says the same for" in " ".join(robot.status()["troubles"])
    robot.pad = up
    robot.stands()
    robot.start()
    robot.drives()
    cli = [sys.executable, "-m", "skytether.cli", "robot"]
    there = ["--folder", str(robot.folder)]
    subprocess.run([*cli, "stop", "somebody fell", *there], check=True, capture_output=True)
    robot.stands()
    shown = subprocess.run([*cli, "gate-status", *there], check=True, capture_output=True, text=True).stdout
    assert "stopped   somebody fell" in shown
    status = subprocess.run([*cli, "gate-status", "--json", *there], check=True, capture_output=True, text=True)
    assert json.loads(status.stdout)["hand"] == "nobody"
    subprocess.run([*cli, "reset", *there], check=True, capture_output=True)
    robot.stands()
    told = subprocess.run([*cli, "start", *there], check=True, capture_output=True, text=True)
    assert "may drive: agent" in told.stderr + told.stdout
    robot.drives()
    for name in ("control.sock", "command.sock", "sensors.sock", "stop.sock"):
        assert (robot.folder / name).stat().st_mode & 0o007 == 0  # closed to other users


def test_wheels_that_are_blocked_stop_the_robot_until_a_reset(robot):
    robot.drives()
    robot.blocked = True
    robot.stands()
    assert "the wheels do not move" in robot.status()["stopped"]
    robot.blocked = False
    robot.stands()
    ask(robot.folder, {"do": "reset"}, PATIENCE_S)
    robot.start()
    robot.drives()


def test_the_enable_signal_takes_power_away(robot):
    robot.drives()
    robot.powered()
    assert robot.status()["guard"]["enabled"] is True
    ask(robot.folder, {"do": "stop"}, PATIENCE_S)
    robot.stands()
    robot.cut()
    ask(robot.folder, {"do": "reset"}, PATIENCE_S)
    robot.powered()
    robot.start()
    robot.drives()
    hung = gate_pid(robot)
    os.kill(hung, signal.SIGSTOP)  # another one in place of a killed one may be there before its silence counts
    edges = len(robot.edges)

    def another_gate() -> bool:
        return any(later - earlier > 0.2 for earlier, later in pairwise(robot.edges[edges:]))

    wait(another_gate, "the enable signal is still until there is another gate, and changes again", robot)
    assert gate_pid(robot) != hung
    robot.start()
    robot.drives()
    robot.guard.send_signal(signal.SIGSTOP)
    robot.cut()
    robot.guard.send_signal(signal.SIGCONT)
    robot.powered()
    robot.guard.kill()
    robot.cut()


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def test_an_agent_that_was_frozen_gives_no_pulse(robot):
    """What it had in mind before is not driven for a moment and then taken back: the velocity goes up from zero."""
    for _ in range(3):
        robot.drives()
        robot.agent.send_signal(signal.SIGSTOP)
        robot.stands()
        robot.told.clear()
        robot.agent.send_signal(signal.SIGCONT)
        robot.drives()
        linear = [velocity for velocity, _ in list(robot.told)]
        moving = linear[next(i for i, velocity in enumerate(linear) if velocity > 0) :]
        assert 0.0 not in moving[: next(i for i, velocity in enumerate(moving) if velocity > 0.15)]
        # 1 m/s^2 at 50 Hz; the guard may count up to guard_s where the machine is busy.
        assert moving[0] <= 0.1
        assert max(after - before for before, after in pairwise(moving)) <= 0.1


class Pushed:
    """Wheels that are the gate's, and somebody who pushes."""

    topics = {"force": WrenchStamped}

    def read(self, now):
        return [("force", WrenchStamped(wrench=Wrench(force=Vector3(x=24.0))))]

    def write(self, twist):
        raise AssertionError("the wheels are the gate's")


def test_a_robot_without_an_instance_is_stopped_from_afar_once(robot, tmp_path):
    """The order outlives the orchestrator, its robot acknowledges it, and after a reset it does not stop again."""
    robot.drives()
    robot.agent.terminate()
    robot.agent.wait()
    (tmp_path / "state").mkdir()
    with EmbeddedOrchestrator(tmp_path / "state") as orchestrator:
        with Client(orchestrator.url, orchestrator.operator_token) as operator:
            token = operator.create_robot(RobotCreate(name="walker", services=())).token
            order = operator.stop_robot("walker", "smoke in the hall")
        orchestrator.kill()
        config = AgentConfig(
            robot="walker",
            url=orchestrator.url,
            token=token,
            service="virtual-trail",
            fallback="admittance",
            gate=robot.folder,
            stop_from_afar=True,
        )
        with (
            closing(GateLink(robot.folder)) as link,
            Agent(config, GatedHardware(Pushed(), link)) as agent,
            Client(orchestrator.url, orchestrator.operator_token) as operator,
        ):
            robot.drives()
            time.sleep(2 * remote_stop.PERIOD_S)
            robot.drives()  # an orchestrator that is away stops nobody
            orchestrator.start()
            wait(lambda: "smoke in the hall" in robot.status()["stopped"], "the order to be obeyed", robot)
            robot.stands()
            wait(lambda: operator.robots()[0].stop.acknowledged_at is not None, "the acknowledgement", robot)
            wait(lambda: "smoke in the hall" in agent.status().gate.stopped, "the gate's state at the agent", robot)
            wait(lambda: agent.status().driver.told.stopped != "", "the gate's answer at the control loop", robot)
            assert agent.status().driver.velocity == (0.0, 0.0)
            assert agent.report().gate.stopped == agent.status().gate.stopped
            wait(lambda: "smoke in the hall" in reported(operator).stopped, "its state at the orchestrator", robot)
            assert not operator.instances()
            assert operator.stop_robot("walker", "once more").id != order.id
            wait(lambda: operator.robots()[0].stop.acknowledged_at is not None, "the second acknowledgement", robot)
            ask(robot.folder, {"do": "reset"}, 30)
            robot.start()
            robot.drives()
            time.sleep(2 * remote_stop.PERIOD_S)
            robot.drives()
            assert robot.status()["stopped"] == ""
