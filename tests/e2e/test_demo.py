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
from skytether.robot.arbiter import Reason
from skytether.robot.command import Source

pytestmark = pytest.mark.slow

MID_TRAIL_M = 3.0
LOCAL_WITHIN_S = 0.3


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
        assert set(topic) == {"sent", "delivered", "lost", "delay_p50_ms", "delay_p99_ms", "jitter_ms"}
        assert topic["delivered"] + topic["lost"] <= topic["sent"]
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


def walk(demo: Demo, break_it) -> tuple[float, object]:
    """Walk the trail; call ``break_it`` once in mid-trail. Returns when that was, and the result."""
    began: list[float] = []

    def watch(s, status):
        if s >= MID_TRAIL_M and not began:
            assert status.driver.source is Source.CLOUD
            began.append(time.monotonic())
            threading.Thread(target=break_it).start()

    result = demo.walk(watch)
    assert result.measures.completed
    return began[0], result


def transitions_after(result, moment: float) -> list[tuple[float, Source, Reason]]:
    return [(t.at - moment, t.source, t.reason) for t in result.status.driver.transitions if t.at > moment]


def test_killed_service_is_replaced_and_the_trail_completed(demo):
    killed = []

    def kill():
        killed.append(pid_of_service(demo))
        os.kill(killed[0], signal.SIGKILL)
        killed.append(time.monotonic())

    _, result = walk(demo, kill)
    (to_local, source, reason), (_, back, why) = transitions_after(result, killed[1])[:2]
    assert (source, reason) == (Source.FALLBACK, Reason.NO_COMMAND)
    assert to_local < LOCAL_WITHIN_S
    assert (back, why) == (Source.CLOUD, Reason.RECOVERED)
    assert result.status.instance.restarts == 1
    assert result.measures.kte_m < 0.1


def test_cut_network_hands_over_and_back(demo):
    cut = []

    def break_network():
        up, down = demo.network.up, demo.network.down
        demo.network.set(up=replace(up, cut=True), down=replace(down, cut=True))
        cut.append(time.monotonic())
        time.sleep(3)
        demo.network.set(up=up, down=down)

    _, result = walk(demo, break_network)
    (to_local, source, reason), (back_after, back, why) = transitions_after(result, cut[0])[:2]
    assert (source, reason) == (Source.FALLBACK, Reason.NO_COMMAND)
    assert to_local < LOCAL_WITHIN_S
    assert (back, why) == (Source.CLOUD, Reason.RECOVERED)
    assert back_after > 3
    assert result.fallback_s > 3
    assert result.status.instance.restarts == 0


def test_killed_orchestrator_does_not_stop_the_walk_and_comes_back(demo):
    before = []

    def kill():
        before.append((instance_of(demo), pid_of_service(demo)))
        demo.orchestrator.kill()
        before.append(time.monotonic())
        time.sleep(3)
        demo.orchestrator.start()

    _, result = walk(demo, kill)
    # Nobody on the way of a velocity command was killed: the walker is guided all the way.
    assert transitions_after(result, before[1]) == []
    (instance, pid), _ = before
    assert instance_of(demo).id == instance.id
    assert instance_of(demo).restarts == 0
    assert pid_of_service(demo) == pid
    assert instance_of(demo).lease_expires_at > instance.lease_expires_at
