"""What robots say of their gates by themselves: shown while it is fresh, with an instance or without, by any of several
orchestrators."""

from __future__ import annotations

from typing import Any

import pytest
from sqlalchemy.exc import OperationalError

from skytether.api.client import ApiError
from skytether.api.rest import GateReport, InstanceCreate, Renew, Report, RobotCreate
from skytether.orchestrator.access.access import Principal
from skytether.orchestrator.domain.errors import ForbiddenError
from skytether.orchestrator.domain.security import TokenHash, new_token
from skytether.orchestrator.robots.gates import Gates
from skytether.orchestrator.store.database import RobotRow, TokenRow
from skytether.orchestrator.store.store import Store

STOPPED = GateReport(answers=True, stopped="somebody fell", hand="nobody", zone="free", troubles=2)
DRIVES = GateReport(answers=True, hand="joystick", zone="free")
WALKER = Principal("walker")


@pytest.fixture
def gates(store: Store, clock: Any) -> Gates:
    for robot in ("walker", "other"):
        token = TokenRow(robot, robot, robot, (), TokenHash.of(new_token()), 0.0)
        store.add_robot(RobotRow(robot, ("*",), 0.0), token)
    return Gates(store, 15.0, clock)


def test_a_robot_without_an_instance_is_in_the_list_and_in_the_metrics(served: Any) -> None:
    walker = served.client(served.operator.create_robot(RobotCreate(name="walker")).token)
    served.operator.create_robot(RobotCreate(name="silent"))
    walker.report_gate("walker", STOPPED)
    text = served.operator.metrics()
    for sample in (
        'gate_up{robot="walker"} 1.0',
        'gate_stopped{robot="walker"} 1.0',
        'gate_troubles{robot="walker"} 2.0',
    ):
        assert f"skytether_{sample}" in text
    assert 'robot="silent"' not in text
    silent, shown = served.operator.robots()
    assert (shown.gate, silent.gate, silent.gate_heard_at) == (STOPPED, None, None)
    assert shown.gate_heard_at is not None
    walker.report_gate("walker", DRIVES)
    assert 'skytether_gate_stopped{robot="walker"} 0.0' in served.operator.metrics()
    assert served.operator.robots()[1].gate == DRIVES


def test_what_comes_with_a_renewal_is_the_same(served: Any) -> None:
    served.site("lab")
    walker = served.robot("walker")
    made = walker.create_instance(InstanceCreate(robot="walker", service="toy"))
    walker.wait_running(made.id, timeout=5)
    walker.renew_instance(made.id, Renew(report=Report(gate=STOPPED)))
    assert 'skytether_gate_stopped{robot="walker"} 1.0' in served.operator.metrics()
    walker.report_gate("walker", DRIVES)
    text = served.operator.metrics()
    assert text.count('skytether_gate_stopped{robot="walker"}') == 1
    assert 'skytether_gate_stopped{robot="walker"} 0.0' in text


def test_of_a_robot_that_nobody_registered_there_is_no_state_at_any_time(gates: Gates) -> None:
    """An operator's token renews for any name. What was neither kept nor hidden came and went in the metrics."""
    gates.keep_report("nobody", STOPPED)
    gates.keep_report("walker", DRIVES)
    assert gates.fresh() == {"walker": DRIVES}
    gates.write()
    assert gates.fresh() == {"walker": DRIVES}


def test_only_the_robot_itself_says_how_its_gate_is(served: Any) -> None:
    served.operator.create_robot(RobotCreate(name="walker"))
    stranger = served.client(served.operator.create_robot(RobotCreate(name="stranger")).token)
    for who in (stranger, served.operator):
        with pytest.raises(ApiError, match="only robot 'walker' itself"):
            who.report_gate("walker", DRIVES)


def test_a_robot_that_falls_silent_has_no_state_after_a_while(gates: Gates, clock: Any) -> None:
    gates.receive_report(WALKER, "walker", STOPPED)
    gates.write()
    heard = clock()
    clock.forward(14.9)
    assert gates.fresh() == {"walker": STOPPED}
    clock.forward(0.2)
    assert gates.fresh() == {}
    assert {robot: (row.at, row.report) for robot, row in gates.all().items()} == {"walker": (heard, None)}


def test_a_clock_that_was_set_back_keeps_nothing_fresh_and_refuses_nothing(gates: Gates, clock: Any) -> None:
    gates.receive_report(WALKER, "walker", STOPPED)
    gates.write()
    clock.set_by(-3600)
    assert gates.fresh() == {}
    gates.receive_report(WALKER, "walker", DRIVES)
    gates.write()
    assert gates.fresh() == {"walker": DRIVES}


def test_any_of_several_orchestrators_may_be_told(gates: Gates, store: Store, clock: Any) -> None:
    other = Gates(store, 15.0, clock)
    gates.receive_report(WALKER, "walker", STOPPED)
    gates.write()
    clock.forward(2)
    other.receive_report(WALKER, "walker", DRIVES)
    other.write()
    gates.write()
    assert gates.fresh() == other.fresh() == {"walker": DRIVES}


def test_what_cannot_be_written_is_kept_and_what_came_meanwhile_is_newer(
    gates: Gates, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    gates.receive_report(WALKER, "walker", STOPPED)
    gates.receive_report(Principal("other"), "other", DRIVES)

    def away(*_: Any) -> None:
        gates.receive_report(WALKER, "walker", DRIVES)
        raise OperationalError("", None, Exception("the database is away"))

    with monkeypatch.context() as patch:
        patch.setattr(store, "save_gates", away)
        with pytest.raises(OperationalError):
            gates.write()
    gates.write()
    assert gates.fresh() == {"walker": DRIVES, "other": DRIVES}


def test_a_robot_that_was_deleted_meanwhile_harms_nothing(gates: Gates, store: Store) -> None:
    gates.receive_report(Principal("other"), "other", DRIVES)
    gates.receive_report(WALKER, "walker", DRIVES)
    store.delete_robot("other")
    gates.write()
    assert gates.fresh() == {"walker": DRIVES}
    store.delete_robot("walker")
    assert gates.all() == {}


def test_a_robot_says_nothing_for_another(gates: Gates) -> None:
    with pytest.raises(ForbiddenError):
        gates.receive_report(WALKER, "other", DRIVES)
