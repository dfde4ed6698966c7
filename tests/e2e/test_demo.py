"""The main job on the real thing: processes, sockets, an emulated network; and what can break in mid-trail."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import psutil
import pytest

from skytether.api.client import Client
from skytether.lab.demo import ROBOT, Demo, DemoSettings
from skytether.robot.control.arbiter import Reason
from skytether.robot.control.command import Source
from skytether.robot.control.supervisor import VelocityLimits

pytestmark = pytest.mark.slow

LOCAL_WITHIN_S = VelocityLimits().silence_s + 0.1
"""What may be learned to wait for on a busy machine, and some turns of the control loop that come late there."""


def mentioning(path: Path) -> list[psutil.Process]:
    """Processes that have to do with a folder."""
    return [p for p in psutil.process_iter(["cmdline", "cwd"]) if str(path) in str(p.info)]


def test_demo_prints_one_json_object_and_leaves_nothing_behind(tmp_path):
    temporary = tmp_path / "tmp"
    temporary.mkdir()
    result = subprocess.run(
        [
            *(sys.executable, "-m", "skytether.cli", "demo", "--json", "--output", tmp_path / "out"),
            *("--rtt-ms", "300", "--loss", "0.02", "--seed", "1"),
        ],
        env={**os.environ, "TMPDIR": str(temporary)},
        capture_output=True,
        text=True,
        timeout=150,
    )
    assert result.returncode == 0, result.stderr
    document = json.loads(result.stdout)
    assert set(document) == {
        "completed", "time_s", "mean_speed_m_s", "kte_m", "start_s", "rtt_ms", "fallback_s", "topics", "plot",
    }  # fmt: skip
    assert document["completed"]
    assert 9 / 0.25 * 0.95 < document["time_s"] < 90  # never faster than the limit of 0.25 m/s
    assert document["kte_m"] < 0.1
    assert 295 < document["rtt_ms"] < 350
    assert set(document["topics"]) == {"force", "wheels", "odom", "cmd_vel"}
    for topic in document["topics"].values():
        ended = {"delivered", "superseded", "lost", "unsettled"}
        assert set(topic) == {"refused", "dropped", "sent", "delay_p50_ms", "delay_p99_ms", "jitter_ms", *ended}
        assert sum(topic[name] for name in ended) == topic["sent"]
        assert topic["delivered"] > 0.97 * topic["sent"]
        assert 145 < topic["delay_p50_ms"] < 200
    assert Path(document["plot"]).read_bytes().startswith(b"\x89PNG")
    assert mentioning(temporary) == []
    assert list(temporary.iterdir()) == []


@pytest.fixture
def demo(tmp_path):
    state = tmp_path / "state"
    state.mkdir()
    with Demo(DemoSettings(rtt_s=0.05, loss=0.01, output=tmp_path / "out", state_dir=state)) as running:
        yield running
    assert mentioning(state) == []


def instance_of(demo: Demo):
    with Client(demo.orchestrator.url, demo.orchestrator.operator_token) as client:
        (instance,) = [i for i in client.instances() if i.robot == ROBOT and not i.state.final]
        return instance


def pid_of_service(demo: Demo) -> int:
    (run,) = demo.orchestrator.state_dir.rglob(f"{instance_of(demo).id}/run.json")
    return json.loads(run.read_text())["process"][0]


class Faults:
    """What breaks, at which place of the trail; each once, while the service drives."""

    def __init__(self, demo: Demo) -> None:
        self.demo = demo
        self.waiting = [(1.0, self.orchestrator), (4.0, self.network), (6.5, self.service)]
        self.at: list[float] = []
        self.running: threading.Thread | None = None

    def watch(self, s, status) -> None:
        busy = self.running is not None and self.running.is_alive()
        if self.waiting and s >= self.waiting[0][0] and status.driver.source is Source.CLOUD and not busy:
            self.running = threading.Thread(target=self.waiting.pop(0)[1])
            self.running.start()

    def orchestrator(self) -> None:
        self.instance, self.pid = instance_of(self.demo), pid_of_service(self.demo)
        self.at.append(time.monotonic())
        self.demo.orchestrator.kill()
        time.sleep(3)
        self.demo.orchestrator.start()

    def network(self) -> None:
        # The orchestrator is back: it took over what ran, and the robot renewed its lease.
        self.adopted, self.adopted_pid = instance_of(self.demo), pid_of_service(self.demo)
        up, down = self.demo.network.up, self.demo.network.down
        self.at.append(time.monotonic())
        self.demo.network.set(up=replace(up, cut=True), down=replace(down, cut=True))
        time.sleep(3)
        self.demo.network.set(up=up, down=down)

    def service(self) -> None:
        pid = pid_of_service(self.demo)
        self.at.append(time.monotonic())
        os.kill(pid, signal.SIGKILL)


def test_the_trail_is_completed_whatever_breaks_on_the_way(demo):
    faults = Faults(demo)
    result = demo.walk(faults.watch)
    assert result.measures.completed
    assert result.measures.kte_m < 0.1
    changes = [(t.at, t.source, t.reason) for t in result.status.driver.transitions]
    orchestrator, network, service = faults.at

    # Nobody on the way of a velocity command was killed: at most a busy machine lets one come too late.
    assert all(reason is not Reason.DISCONNECTED for at, _, reason in changes if orchestrator < at < network)
    assert (faults.adopted.id, faults.adopted_pid, faults.adopted.restarts) == (faults.instance.id, faults.pid, 0)
    assert faults.adopted.lease_expires_at > faults.instance.lease_expires_at

    for fault, away_s in ((network, 3.0), (service, 0.0)):
        (to_local, *first), (back_at, *second) = [change for change in changes if change[0] > fault][:2]
        assert first == [Source.FALLBACK, Reason.NO_COMMAND]
        assert to_local - fault < LOCAL_WITHIN_S
        assert second == [Source.CLOUD, Reason.RECOVERED]
        assert back_at - fault > away_s
    assert result.status.instance.restarts == 1
    assert result.fallback_s > 3
