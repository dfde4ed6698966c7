"""Real processes, real sockets: what only shows there."""

from __future__ import annotations

import json
import signal
import socket
import time
from pathlib import Path

import pytest

from skytether.api.service_report import pull_step_s
from skytether.messages import LaserScan, Twist, Vector3, decode, encode
from skytether.wire.events import Connected, Disconnected

pytestmark = pytest.mark.slow

SCAN = encode(LaserScan(angle_increment=0.1, ranges=[1.0]), "ros1")


def wait_ready(child, path: Path) -> dict:
    deadline = time.monotonic() + 10
    while not path.exists():
        assert child.poll() is None, child.communicate()[1]
        assert time.monotonic() < deadline, "not ready in 10 s"
        time.sleep(0.005)  # the file is how a runtime learns of it, too
    return json.loads(path.read_text())


def write_module(folder: Path, step: str) -> None:
    (folder / "under_test.py").write_text(
        "import time\n"
        "from skytether.messages import LaserScan, Twist\n"
        "from skytether.service import Input, NoParams, Output, Service, run\n"
        "class UnderTest(Service[NoParams]):\n"
        "    rate_hz = 50.0\n"
        "    scan = Input(LaserScan)\n"
        "    cmd_vel = Output(Twist)\n"
        "    def step(self, now):\n"
        f"        {step}\n"
        "    def stop(self):\n"
        "        self.log.info('closing what is open')\n"
        "run(UnderTest)\n"
    )


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_from_grant_to_goodbye(grant, robot, spawn, number) -> None:
    child = spawn("wall_stop", grant(params={"speed": 0.25}))
    ready = wait_ready(child, grant.ready)
    assert ready["pid"] == child.pid
    robot.bridge.set_peer("127.0.0.1", ready["port"])
    robot.wait_for(lambda: robot.heard(Connected))
    assert robot.bridge.publish("scan", SCAN)
    robot.wait_for(lambda: bool(robot.messages))
    assert robot.messages[0].topic == "cmd_vel"
    assert decode(Twist, robot.messages[0].payload, "ros1") == Twist(Vector3(x=0.25))

    child.send_signal(number)
    _, stderr = child.communicate(timeout=10)
    assert child.returncode == 0, stderr
    assert "Traceback" not in stderr
    robot.wait_for(lambda: robot.heard(Disconnected))
    assert next(e.reason for e in robot.events if isinstance(e, Disconnected)) == "goodbye"


def test_nobody_comes_and_it_ends_by_itself(grant, spawn) -> None:
    child = spawn("wall_stop", grant(idle_exit_s=0.2))
    _, stderr = child.communicate(timeout=10)
    assert child.returncode == 0
    assert "no robot for 0.2 s: ending" in stderr


def test_an_exception_in_step_ends_the_process_with_its_traceback(grant, robot, spawn, tmp_path) -> None:
    write_module(tmp_path, "if self.scan.take(): raise ZeroDivisionError('in step')")
    child = spawn("under_test", grant(), tmp_path)
    robot.bridge.set_peer("127.0.0.1", wait_ready(child, grant.ready)["port"])
    robot.wait_for(lambda: robot.heard(Connected))
    robot.bridge.publish("scan", SCAN)
    _, stderr = child.communicate(timeout=10)
    assert child.returncode == 1
    assert "ZeroDivisionError: in step" in stderr
    assert "Traceback" in stderr
    assert "closing what is open" in stderr
    robot.wait_for(lambda: robot.heard(Disconnected))


def test_a_slow_step_does_not_delay_the_bridge(grant, robot, spawn, tmp_path) -> None:
    write_module(tmp_path, "time.sleep(0.5)")
    child = spawn("under_test", grant(), tmp_path)
    robot.bridge.set_peer("127.0.0.1", wait_ready(child, grant.ready)["port"])
    robot.wait_for(lambda: robot.heard(Connected))
    deadline = time.monotonic() + 5
    while not (paths := robot.bridge.stats().paths) or not paths[0].rtt_p50 < 0.1:
        assert time.monotonic() < deadline, paths
        robot.bridge.publish("scan", SCAN)
        time.sleep(0.02)
    child.terminate()
    _, stderr = child.communicate(timeout=10)
    assert child.returncode == 0
    assert "closing what is open" in stderr


def test_how_long_steps_take_is_told_where_it_is_wanted(grant, robot, spawn, tmp_path) -> None:
    write_module(tmp_path, "time.sleep(0.03)")
    child = spawn("under_test", grant(step_times=True), tmp_path)
    wait_ready(child, grant.ready)
    reports = grant.ready.with_name("reports.json")
    deadline = time.monotonic() + 10
    while not reports.exists():
        assert time.monotonic() < deadline
        time.sleep(0.02)
    told = pull_step_s(json.loads(reports.read_text()))
    assert told is not None
    assert told >= 0.03
    child.terminate()
    child.communicate(timeout=10)


def test_wrong_params_end_with_one_sentence_and_status_2(grant, spawn) -> None:
    child = spawn("wall_stop", grant(params={"sped": 1}))
    stdout, stderr = child.communicate(timeout=10)
    assert child.returncode == 2
    assert stderr == "error: there is no parameter 'sped'; there are distance, speed\n"
    assert stdout == ""
    assert not grant.ready.exists()


def test_a_taken_port_is_said(grant, spawn) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        port = other.getsockname()[1]
        child = spawn("wall_stop", grant(bind_port=port))
        _, stderr = child.communicate(timeout=10)
    assert child.returncode == 1
    assert stderr.startswith(f"error: cannot listen on UDP 127.0.0.1:{port}: ")
    assert stderr.count("\n") == 1


def test_what_it_reports_is_in_a_file_beside_its_ready_file(grant, spawn, tmp_path) -> None:
    write_module(tmp_path, "self.report('lost', 'The robot was carried away.')")
    child = spawn("under_test", grant(), tmp_path)
    told = wait_ready(child, tmp_path / "reports.json")["reports"]
    assert told == [{"number": 1, "code": "lost", "message": "The robot was carried away."}]
