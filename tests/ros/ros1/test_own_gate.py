"""``skytether robot run`` on a real master, and the gate that it starts: how it begins, and how everything ends."""

import json
import os
import signal
import socket
import sys
import time
import urllib.request

import psutil
import pytest
import yaml
from gate_robot import forget_stops
from ros1_graph import wait_for

from skytether.robot.safety.client import GateError, ask, listens

SECTION = {
    "footprint": {"radius": 0.3},
    "sensors": {"/scan": {"max_age_s": 1.0}},
    "unseen": {"action": "free"},
    "guard_s": 0.5,
}
pytestmark = [pytest.mark.ros1, pytest.mark.slow]


@pytest.fixture
def start(graph, config, tmp_path, monkeypatch):
    """Writes robot.yaml and starts something with it; its gate's folder is `start.folder`."""

    def start(*arguments, **more):
        document = yaml.safe_load(config.read_text())
        document.pop("safety", None)
        document["limits"] = {"max_gap_s": 0.3}
        config.write_text(yaml.safe_dump({**document, **more}))
        paths = {"PATH": os.environ["PATH"], "PYTHONPATH": os.pathsep.join(sys.path)}
        environment = {**graph.environment, **paths, "SKYTETHER_GATE_FOLDER": str(start.folder)}
        with start.log.open("ab") as log:
            return graph.skytether("robot", *arguments, str(config), stdout=log, stderr=log, env=environment)

    start.folder, start.log = tmp_path / "gate", tmp_path / "log"
    forget_stops(start.folder, monkeypatch)
    return start


def drives(walker):
    wait_for(lambda: walker.speed is not None and walker.speed > 0.199, "the service to drive")


def children_of(process, folder):
    """Processes of the gate: they outlive the agent."""
    found = psutil.Process(process.pid).children(recursive=True)
    assert listens(folder)
    return found


def gone(processes):
    return psutil.wait_procs(processes, timeout=30)[1] == []


def slowest(told, since):
    """The largest step between two velocities that the wheels were told."""
    steps = [abs(b - a) for a, b in zip(told[since:], told[since + 1 :], strict=False)]
    return max(steps, default=0.0)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])  # below are all that tell it to end
def test_without_a_section_there_is_a_gate_that_stops_the_wheels_and_ends_with_the_agent(graph, walker, start, number):
    agent = start("run")
    drives(walker)
    gate = children_of(agent, start.folder)
    assert gate
    assert "/skytether" not in graph.publishers("/cmd_vel")
    before = len(walker.told)
    agent.send_signal(number)
    wait_for(lambda: walker.speed == 0.0, "the standstill")
    assert gone(gate)
    assert walker.speed == 0.0
    assert slowest(walker.told, before - 1) < 0.15, "it brakes, it does not break off"
    said = start.log.read_text()
    assert "robot.yaml has no section safety" in said
    assert not listens(start.folder)
    # And it can be started again.
    agent = start("run")
    drives(walker)
    graph.end(agent)


@pytest.mark.parametrize("first", [signal.SIGINT, signal.SIGKILL])
def test_a_service_manager_that_signals_all_of_the_unit_lets_the_gate_brake(walker, start, first):
    """As KillMode=control-group does: all at once, or what is left when the agent is dead."""
    agent = start("run")
    drives(walker)
    gate = children_of(agent, start.folder)
    before = len(walker.told)
    agent.send_signal(first)
    for process in gate:
        process.send_signal(signal.SIGINT)
    wait_for(lambda: walker.speed == 0.0, "the standstill")
    assert gone(gate)
    assert agent.wait(60) in (128 + signal.SIGINT, -first)
    assert walker.speed == 0.0
    assert slowest(walker.told, before - 1) < 0.15, "it brakes, it does not break off"


def test_without_a_gate_the_last_velocity_of_a_killed_agent_is_the_last_word(walker, start):
    """Why there is one unless robot.yaml says otherwise: this row of docs/safety.md."""
    agent = start("run", safety="none")
    drives(walker)
    agent.kill()
    agent.wait()
    time.sleep(3.0)
    assert walker.speed == pytest.approx(0.2, abs=1e-3)
    assert "there is no gate (safety: none)" in start.log.read_text()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
def test_without_a_gate_an_agent_that_is_told_to_end_stops_the_wheels_first(walker, start, number):
    agent = start("run", safety="none")
    drives(walker)
    agent.send_signal(number)
    agent.wait(60)
    assert walker.speed == 0.0


def test_a_gate_that_runs_already_is_used_and_stays(graph, walker, start):
    section = SECTION
    gate = start("gate", safety=section)
    wait_for(lambda: listens(start.folder), "the gate")
    agent = start("run", safety=section)
    let_go(start.folder)
    drives(walker)
    graph.end(agent)
    wait_for(lambda: walker.speed == 0.0, "the standstill")
    assert gate.poll() is None
    assert ask(start.folder, {"do": "status"}, 30)
    assert "uses the one that runs" in start.log.read_text()
    gate.terminate()
    gate.wait(30)


def let_go(folder):
    """As a person does: reset, and start."""

    def done() -> bool:
        try:
            ask(folder, {"do": "reset"}, 30)
            ask(folder, {"do": "start"}, 30)
        except GateError as error:
            return "there is no request" in str(error)
        return True

    wait_for(done, "the reset")


def test_with_a_section_the_gate_is_started_too_and_a_killed_one_is_started_again(graph, walker, start):
    section = SECTION
    agent = start("run", safety=section)
    wait_for(lambda: listens(start.folder), "the gate")
    let_go(start.folder)
    drives(walker)
    guard = min(children_of(agent, start.folder), key=lambda process: process.create_time())
    guard.kill()
    wait_for(lambda: walker.speed == 0.0, "the standstill")
    wait_for(lambda: "it is started again" in start.log.read_text(), "another gate")
    wait_for(lambda: listens(start.folder), "the gate, again")
    let_go(start.folder)
    drives(walker)
    graph.end(agent)


def test_the_check_says_what_the_gate_is_or_will_be(graph, walker, start, config):
    def check(**more):
        process = start("run", "--check", **more)
        status = process.wait(60)
        said = " ".join(start.log.read_text().split())
        start.log.unlink()
        return status, said

    status, said = check()
    assert status == 0, said
    assert "does not run yet" in said
    assert "no section safety" in said
    status, said = check(safety="none")
    assert status == 0, said
    assert "there is no gate" in said


def test_a_stop_that_a_person_asked_for_outlives_gate_and_reboot_without_a_section(walker, start, graph):
    agent = start("run")
    drives(walker)
    ask(start.folder, {"do": "stop", "reason": "somebody fell"}, 30)
    wait_for(lambda: walker.speed == 0.0, "the standstill")
    graph.end(agent)
    (start.folder / "latch").unlink()  # what a reboot does to a tmpfs
    agent = start("run")
    wait_for(lambda: listens(start.folder), "the gate")
    time.sleep(3.0)
    assert "somebody fell" in wait_for(lambda: ask(start.folder, {"do": "status"}, 30)["stopped"], "the stop")
    assert walker.speed == 0.0
    let_go(start.folder)
    drives(walker)
    graph.end(agent)


@pytest.mark.parametrize("safety", ["none", {"footprint": {"radius": 0.3}, "sensors": {}}])
def test_who_else_publishes_the_wheels_topic_is_named_and_counted(graph, walker, start, safety):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    agent = start("run", safety=safety, status_port=port)
    wait_for(lambda: graph.publishers("/cmd_vel"), "ours")
    time.sleep(3.0)
    assert "publishes /cmd_vel too" not in start.log.read_text()
    other = graph.start("rostopic", "pub", "-r", "5", "/cmd_vel", "geometry_msgs/Twist", "{}")
    wait_for(lambda: "publishes /cmd_vel too" in start.log.read_text(), "the other one to be named")

    def status():
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/status", timeout=30) as answer:
            return json.load(answer)["other_publishers"]

    # With a gate it is the gate that looks; the agent hears of it a moment later.
    (name,) = wait_for(lambda: status()["names"], "the agent to know")
    assert name.startswith("/rostopic")
    assert status()["noticed"] == 1
    assert start("run", "--check", safety=safety).wait(60) == 1
    graph.end(other)
    wait_for(lambda: status() == {"names": [], "noticed": 1}, "the other one to be gone")
    graph.end(agent)


def test_a_gate_of_another_robot_is_not_used(graph, walker, start):
    gate = start("gate", safety=SECTION)
    wait_for(lambda: listens(start.folder), "the gate")
    agent = start("run", safety={**SECTION, "ros1": {"cmd_vel": "/other/cmd_vel"}})
    assert agent.wait(60) == 1
    said = " ".join(start.log.read_text().split())
    assert "has other wheels (/cmd_vel at the ROS master" in said
    assert "than robot.yaml says (/other/cmd_vel at" in said
    gate.terminate()
    gate.wait(30)
