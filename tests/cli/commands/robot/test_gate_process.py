"""The gate of ``robot run``: one that was found, and ends; one of its own, and what becomes of it beside others."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from skytether.cli.commands.robot import gate_process
from skytether.cli.commands.robot.gate_process import FoundGate, OwnGate
from skytether.guard.protocol import FIRST_ACT
from skytether.robot.safety.client import GateError


class Own:
    def __init__(self, config, safety, *, assumed):
        self.assumed, self.closed = assumed, False

    def ensure_running(self):
        return "own"

    def close(self):
        self.closed = True


class Robot:
    def __init__(self):
        self.now, self.there, self.made = 100.0, True, []
        self.gate = FoundGate(
            "robot.yaml",
            SimpleNamespace(place=lambda: "run"),
            assumed=True,
            make=self.make,
            there=lambda folder: self.there,
            clock=lambda: self.now,
        )

    def make(self, *arguments, **more):
        self.made.append(Own(*arguments, **more))
        return self.made[-1]

    def look(self, seconds):
        for _ in range(round(seconds / 0.5)):
            self.now += 0.5
            said = self.gate.ensure_running()
        return said


@pytest.fixture
def robot():
    return Robot()


def test_the_gate_of_an_agent_that_was_killed_is_followed_by_one_of_our_own(robot):
    robot.look(3.0)
    robot.there = False
    robot.look(1.0)
    assert not robot.made, "it may be started anew"
    robot.look(0.5)
    assert robot.made[0].assumed
    assert robot.look(0.5) == "own"
    robot.gate.close()
    assert robot.made[0].closed


def test_a_gate_that_is_started_anew_or_ended_later_is_left_alone(robot):
    robot.there = False
    robot.look(1.0)
    robot.there = True
    robot.look(20.0)
    robot.there = False
    assert robot.look(60.0) == ""
    robot.gate.close()
    assert not robot.made


@pytest.mark.slow
def test_who_may_write_where_the_robot_was_started_is_not_its_gate(tmp_path, monkeypatch):
    for name in ("ctypes", "typer"):  # what the two programs on the way import
        (tmp_path / f"{name}.py").write_text("open('came', 'w')\nraise SystemExit(77)\n")
    monkeypatch.chdir(tmp_path)
    safety = SimpleNamespace(place=lambda: tmp_path / "run", record_file=lambda: "record")
    gate = OwnGate(tmp_path / "robot.yaml", safety, assumed=True)
    with pytest.raises(GateError, match="the gate ended with status"):  # there is no robot.yaml
        gate.wait()
    assert not (tmp_path / "came").exists()


class Started:
    """An own gate whose processes are played, in a folder that another guard may have."""

    def __init__(self, monkeypatch, lost=""):
        self.stopped, self.kept, self.lost = "", True, lost
        self.silent: set[str] = set()
        self.now, self.there, self.guard_pid, self.asked, self.processes = 100.0, False, 7, [], []
        monkeypatch.setattr(OwnGate, "_start", lambda _: self.start())
        monkeypatch.setattr(gate_process, "listens", lambda folder: True)
        monkeypatch.setattr(gate_process, "_there", lambda folder: self.there)
        monkeypatch.setattr(gate_process, "ask", self.ask)
        monkeypatch.setattr(gate_process, "lost_at_reboot", lambda path: self.lost)
        safety = SimpleNamespace(place=lambda: Path("run"), record_file=lambda: "record")
        self.gate = OwnGate("robot.yaml", safety, assumed=True, clock=lambda: self.now)

    def start(self):
        process = SimpleNamespace(pid=7, status=None)
        process.poll = lambda: process.status
        self.processes.append(process)
        return process

    def ask(self, folder, request, timeout):
        self.asked.append(request["do"])
        if request["do"] in self.silent:
            raise GateError("it does not answer")
        return {"guard_pid": self.guard_pid, "stopped": self.stopped, "kept": self.kept}

    def look(self, seconds):
        for _ in range(round(seconds / 0.5)):
            self.now += 0.5
            self.gate.ensure_running()


@pytest.fixture
def started(monkeypatch):
    return Started(monkeypatch)


def test_the_own_gate_is_started_once_with_the_robot(started):
    started.gate.wait()
    started.look(5.0)
    assert started.asked == ["status", "status", "start"]


@pytest.mark.parametrize("silent", ["status", "reset", "start"])
def test_a_gate_that_did_not_answer_is_asked_again(started, silent):
    """A busy machine, at the robot's start: else the robot stands, and nobody says why."""
    started.stopped, started.silent = FIRST_ACT, {silent}
    started.gate.wait()
    started.look(1.0)
    started.silent = set()
    started.asked.clear()
    started.look(5.0)
    assert started.asked == ["status", "reset", "start"], "once"


def test_a_gate_that_did_not_answer_in_the_time_of_the_start_is_left_to_a_person(started):
    started.silent = {"status"}
    started.gate.wait()
    started.look(50.0)
    started.silent = set()
    started.look(5.0)
    assert set(started.asked) == {"status"}


def test_where_a_reboot_forgets_a_stop_the_start_of_the_robot_is_no_reset(monkeypatch):
    started = Started(monkeypatch, lost="it is on a tmpfs")
    started.stopped = FIRST_ACT
    started.gate.wait()
    assert "on a tmpfs" in started.gate.ensure_running()
    started.look(50.0)
    assert set(started.asked) == {"status"}


def test_while_a_stop_cannot_be_kept_the_start_of_the_robot_is_no_reset(started):
    started.stopped, started.kept = FIRST_ACT, False
    started.gate.wait()
    started.look(5.0)
    assert set(started.asked) == {"status"}
    started.kept = True
    started.look(5.0)
    assert started.asked[-3:] == ["status", "reset", "start"]


def test_a_gate_of_somebody_else_is_neither_reset_nor_started(started):
    started.guard_pid = 8
    started.gate.wait()
    started.look(50.0)
    assert set(started.asked) == {"status"}


def test_what_begins_late_is_not_the_start_of_the_robot(started):
    """A gate that comes up a minute after the person looked lets nobody drive."""
    started.now += 60.0
    started.gate.wait()
    started.look(5.0)
    assert started.asked == []


def test_where_another_guard_has_the_folder_none_is_started_every_second(started):
    started.there = True
    started.processes[0].status = 1
    started.look(60.0)
    assert len(started.processes) == 1
    started.there = False
    started.look(1.0)
    assert len(started.processes) == 2


def test_one_that_ends_again_and_again_is_started_less_and_less_often(started):
    """Somebody has broken robot.yaml under way."""
    for _ in range(120):
        started.processes[-1].status = 2
        started.look(0.5)
    assert 4 <= len(started.processes) <= 7
    started.processes[-1].status = None
    started.look(60.0)
    started.processes[-1].status = -9
    count = len(started.processes)
    started.look(0.5)
    assert len(started.processes) == count + 1, "one that ran is started at once"
