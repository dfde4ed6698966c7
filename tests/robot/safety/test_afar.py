"""Stop from afar: obeyed once, never undone, and nothing happens while the orchestrator is away."""

from datetime import UTC, datetime

import pytest

from skytether.api.client import ApiError, Unreachable
from skytether.api.rest import Problem, StopOrder
from skytether.robot.safety.afar import FILE, StopFromAfar
from skytether.robot.safety.client import GateError
from skytether.robot.safety.watch import GateWatch

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

    def stop(self, folder, reason):
        if self.error is not None:
            raise self.error
        self.stops.append(reason)
        return {}


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
    return lambda: StopFromAfar(orchestrator, "walker", tmp_path, stop=gate.stop, clock=lambda: 1.0)


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


def test_orders_to_others_and_what_was_acknowledged_is_left_alone(agent, orchestrator, gate):
    orchestrator.order = order(robot="stranger")
    agent().step()
    orchestrator.order = order(acknowledged_at=NOW)
    agent().step()
    assert gate.stops == []


@pytest.mark.parametrize("text", ["", "{", "{}", "[1, 2]", "null"])
def test_a_file_that_is_damaged_is_none(agent, orchestrator, gate, tmp_path, text):
    (tmp_path / FILE).write_text(text)
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
