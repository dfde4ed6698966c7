"""Stop from afar: obeyed once, never undone, and nothing happens while the orchestrator is away."""

import os
from datetime import UTC, datetime

import pytest

from skytether.api.client import ApiError, Unreachable
from skytether.api.rest import Problem, StopOrder
from skytether.robot.agent.gate_watch import GateWatch
from skytether.robot.agent.remote_stop import FILE, RemoteStop
from skytether.robot.safety.client import GateError

NOW = datetime(2026, 1, 1, tzinfo=UTC)


class Orchestrator:
    def __init__(self):
        self.order = None
        self.error = None
        self.acknowledged = []

    def stop_order(self, name):
        if self.error is not None:
            raise self.error
        return self.order

    def acknowledge_stop(self, name, order):
        if self.error is not None:
            raise self.error
        self.acknowledged.append((name, order))
        self.order = self.order.model_copy(update={"acknowledged_at": NOW})
        return self.order


class Gate:
    def __init__(self):
        self.stops = []
        self.error = None
        self.stopped = ""
        self.disk = True
        self.pid = 1

    def stop(self, folder, reason):
        if self.error is not None:
            raise self.error
        self.stops.append(reason)
        self.stopped = reason
        return {} if self.disk else {"note": "the stop is in effect, but could not be kept: the disk is full"}

    def status(self, folder):
        if self.error is not None:
            raise self.error
        return {"stopped": self.stopped, "guard": {"stopped": self.stopped, "kept": self.disk, "pid": self.pid}}


def order(id_="a", **changes):
    return StopOrder(id=id_, robot="walker", reason="fire", by="operator", at=NOW).model_copy(update=changes)


@pytest.fixture
def orchestrator():
    return Orchestrator()


@pytest.fixture
def gate():
    return Gate()


@pytest.fixture
def agent(orchestrator, gate, tmp_path):
    """Makes an agent, as after each of its starts."""
    return lambda: RemoteStop(orchestrator, "walker", tmp_path, stop=gate.stop, status=gate.status, clock=lambda: 1.0)


def test_an_order_is_obeyed_and_acknowledged_once(agent, orchestrator, gate):
    afar = agent()
    afar.step()
    assert gate.stops == []
    orchestrator.order = order()
    for _ in range(3):
        afar.step()
    assert gate.stops == ["stopped from afar by operator: fire"]
    assert orchestrator.acknowledged == [("walker", "a")]
    orchestrator.order = order("b")
    afar.step()
    assert len(gate.stops) == 2


@pytest.mark.parametrize("error", [Unreachable("no orchestrator"), ApiError(Problem(title="-", status=503))])
def test_an_orchestrator_that_is_away_changes_nothing(agent, orchestrator, gate, error):
    orchestrator.error = error
    agent().step()
    assert gate.stops == []


def test_a_stop_that_was_not_kept_is_not_acknowledged_by_the_next_agent_either(agent, orchestrator, gate):
    orchestrator.order = order()
    gate.disk = False
    for started in range(3):
        afar = agent()
        afar.step()
        afar.step()
        assert len(gate.stops) == 2 * (started + 1)
    assert orchestrator.acknowledged == []
    gate.disk = True
    agent().step()
    assert orchestrator.acknowledged == [("walker", "a")]


def test_that_it_is_kept_is_not_believed_of_a_gate_whose_guard_does_not_answer(agent, orchestrator, gate):
    """It has heard that last before the stop."""
    orchestrator.order = order()
    gate.disk = False
    gate.status = lambda folder: {"stopped": gate.stopped, "kept": True, "guard": None}
    afar = agent()
    for _ in range(3):
        afar.step()
    assert orchestrator.acknowledged == []
    gate.disk = True
    afar.step()
    assert orchestrator.acknowledged == [("walker", "a")]


def test_an_order_that_comes_again_does_not_stop_again_after_a_reset(agent, orchestrator, gate):
    """Its acknowledgement is lost, a person resets the robot, the agent is restarted: the same order comes again."""
    orchestrator.order = order()
    orchestrator.acknowledge_stop = lambda name, order: (_ for _ in ()).throw(Unreachable("cut"))
    afar = agent()
    afar.step()
    afar.step()
    assert len(gate.stops) == 1
    del orchestrator.acknowledge_stop
    restarted = agent()
    restarted.step()
    assert len(gate.stops) == 1
    assert orchestrator.acknowledged == [("walker", "a")], "it is still acknowledged"
    orchestrator.order = order("b")
    restarted.step()
    orchestrator.order = order("a")  # an older one, from a backup of the database
    agent().step()
    assert gate.stops == ["stopped from afar by operator: fire"] * 2


def test_what_could_not_be_obeyed_is_not_acknowledged_and_tried_again(agent, orchestrator, gate):
    orchestrator.order = order()
    gate.error = GateError("no gate")
    afar = agent()
    afar.step()
    assert orchestrator.acknowledged == []
    gate.error = None
    afar.step()
    assert orchestrator.acknowledged == [("walker", "a")]


def test_what_could_not_be_kept_is_not_acknowledged_until_it_is(agent, orchestrator, gate):
    orchestrator.order = order()
    gate.disk = False
    afar = agent()
    for _ in range(3):
        afar.step()
    assert gate.stopped
    assert orchestrator.acknowledged == []
    gate.error = GateError("it does not answer")
    afar.step()
    assert orchestrator.acknowledged == []
    gate.error, gate.disk = None, True
    afar.step()
    assert orchestrator.acknowledged == [("walker", "a")]


def test_what_could_not_be_kept_does_not_stop_again_after_a_reset(agent, orchestrator, gate):
    orchestrator.order = order()
    gate.disk = False
    afar = agent()
    afar.step()
    gate.stopped = ""  # a person at the robot has reset it
    afar.step()
    assert len(gate.stops) == 1
    assert orchestrator.acknowledged == [("walker", "a")]


def test_a_guard_that_was_started_anew_and_knows_of_no_stop_is_no_reset(agent, orchestrator, gate):
    """Its disk took nothing, so it comes up as if nobody had stopped the robot."""
    orchestrator.order = order()
    gate.disk = False
    afar = agent()
    afar.step()
    gate.stopped, gate.pid = "", 2
    afar.step()
    assert gate.stopped
    assert orchestrator.acknowledged == []


def test_orders_to_others_and_what_was_acknowledged_is_left_alone(agent, orchestrator, gate):
    orchestrator.order = order(robot="stranger")
    agent().step()
    orchestrator.order = order(acknowledged_at=NOW)
    agent().step()
    assert gate.stops == []


def test_a_reason_is_one_short_line(agent, orchestrator, gate):
    orchestrator.order = order(reason="fire\n\x1b[2J" + "x" * 100_000, by="a\nb")
    agent().step()
    assert gate.stops[0].startswith("stopped from afar by a b: fire [2J")
    assert gate.stops[0].isprintable()
    assert len(gate.stops[0]) <= 200


@pytest.mark.parametrize("text", ["", "{", "{}", "[1, 2]", "null", "[" * 60_000, '["a"' + " " * 70_000 + "]"])
def test_a_file_that_is_damaged_is_none(agent, orchestrator, gate, tmp_path, text):
    (tmp_path / FILE).write_text(text)
    orchestrator.order = order()
    agent().step()
    assert len(gate.stops) == 1


@pytest.mark.parametrize("name", [FILE, FILE + ".new"])
@pytest.mark.parametrize("made", [os.mkfifo, lambda path: path.symlink_to(path.with_name("other"))])
def test_a_pipe_or_a_link_in_the_place_of_the_file_holds_up_nothing(agent, orchestrator, gate, tmp_path, name, made):
    other = tmp_path / "other"
    other.write_text('["a"]')
    made(tmp_path / name)
    orchestrator.order = order()
    agent().step()
    assert len(gate.stops) == 1
    assert orchestrator.acknowledged == [("walker", "a")]
    assert other.read_text() == '["a"]', "written through a link"
    orchestrator.order = order()
    agent().step()
    assert len(gate.stops) == 1, "it is remembered"


def test_a_file_of_somebody_else_is_none(agent, orchestrator, gate, tmp_path, monkeypatch):
    (tmp_path / FILE).write_text('["a"]')
    monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)
    orchestrator.order = order()
    agent().step()
    assert len(gate.stops) == 1


def test_the_gates_state_is_watched(tmp_path):
    answers = [
        {"stopped": "button " + "x" * 500, "hand": None, "zone": "stop", "troubles": ["one", "two"]},
        GateError("gone"),
    ]

    def ask(folder, request, timeout):
        answer = answers.pop(0)
        if isinstance(answer, GateError):
            raise answer
        return answer

    watch = GateWatch(tmp_path, ask)
    assert not watch.report.answers
    watch.step()
    assert watch.report.answers
    assert (watch.report.hand, watch.report.zone, watch.report.troubles) == ("", "stop", 2)
    assert len(watch.report.stopped) == 200
    watch.step()
    assert not watch.report.answers


def test_what_is_kept_of_orders_is_bounded():
    with pytest.raises(ValueError, match="at most 64"):
        StopOrder(id="a" * 65, robot="walker", reason="fire", by="operator", at=NOW)
