"""What services report, as events of their instances: with made-up time, and through a real process."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from reconcile_bench import Bench, add

from skytether.api.manifest import Manifest
from skytether.api.rest import InstanceCreate, State
from skytether.api.service_report import ServiceReport
from skytether.orchestrator.access.access import Principal
from skytether.orchestrator.config.settings import Settings
from skytether.orchestrator.core import Orchestrator
from skytether.orchestrator.domain.records import Record
from skytether.orchestrator.telemetry.service_events import MOST, PERIOD

NewRecord = Callable[..., Record]
OPERATOR = Principal(None)


def reports(*numbers: int) -> tuple[ServiceReport, ...]:
    return tuple(ServiceReport(number, "no_path", f"the {number}.") for number in numbers)


def told(b: Bench) -> list[str]:
    return [event.reason for event in b.store.events("i1", 0) if event.code]


@pytest.fixture
def running(bench: Any, new_record: NewRecord) -> Bench:
    b: Bench = bench()
    add(b, new_record(lease_s=1e6, lease_expires_at=b.clock() + 1e6))
    b.step(2)
    return b


def test_a_report_becomes_one_event_and_changes_no_state(running: Bench) -> None:
    running.runtime.world["i1"].reports = reports(1, 2)
    running.step(3)
    events = running.store.events("i1", 0)[-2:]
    assert [(e.state, e.code, e.reason) for e in events] == [
        (State.RUNNING, "no_path", "the 1."),
        (State.RUNNING, "no_path", "the 2."),
    ]
    assert told(running) == ["the 1.", "the 2."]
    assert running.record().reason == ""


def test_who_watches_is_woken(running: Bench) -> None:
    woken: list[str] = []
    running.store.on_change = woken.append
    running.runtime.world["i1"].reports = reports(1)
    running.step(2)
    assert woken == ["i1"]


def test_the_next_leader_tells_none_twice(running: Bench, tmp_path: Path) -> None:
    running.runtime.world["i1"].reports = reports(1)
    running.step()
    running.restart(tmp_path)
    running.runtime.world["i1"].reports = reports(1, 2)
    running.step(2)
    assert told(running) == ["the 1.", "the 2."]


def test_the_next_run_is_told_from_its_first_report_on(running: Bench) -> None:
    running.runtime.world["i1"].reports = reports(1, 2, 3)
    running.step()
    running.clock.forward(1)
    running.runtime.crash("i1")
    running.step(3)
    assert running.record().attempt == 2
    running.runtime.world["i1"].reports = (ServiceReport(1, "lost", "again"),)
    running.step()
    assert told(running) == ["the 1.", "the 2.", "the 3.", "again"]


def test_of_many_the_newest_are_told_and_few_a_minute(running: Bench) -> None:
    for number in range(1, 100):
        running.runtime.world["i1"].reports = reports(number, number + 1)
        running.step()
    first = told(running)
    assert first == [f"the {number}." for number in range(1, MOST + 1)]
    running.clock.forward(PERIOD)
    running.step()
    assert told(running) == [*first, "the 99.", "the 100."]


def test_what_a_renewal_overtakes_is_told_with_the_next_look(running: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    running.runtime.world["i1"].reports = reports(1)
    tell = running.store.add_service_reports

    def overtaken(record: Record, now: float, said: Any) -> Record | None:
        running.store.renew("i1", now, None)
        monkeypatch.setattr(running.store, "add_service_reports", tell)
        return tell(record, now, said)

    monkeypatch.setattr(running.store, "add_service_reports", overtaken)
    running.step()
    assert told(running) == []
    running.step()
    assert told(running) == ["the 1."]


@contextmanager
def house(folder: Path) -> Iterator[Orchestrator]:
    core = Orchestrator(Settings(state_dir=folder))
    core.start()
    try:
        yield core
    finally:
        core.stop()


def until_told(core: Orchestrator, instance: str, message: str) -> list[tuple[str, str]]:
    deadline = time.monotonic() + 30
    while True:
        found = [(e.code, e.reason) for e in core.store.events(instance, 0) if e.code]
        if any(reason == message for _, reason in found):
            return found
        assert time.monotonic() < deadline, core.store.events(instance, 0)
        time.sleep(0.05)


@pytest.mark.slow
def test_what_a_process_reports_is_an_event_once_over_a_restart_of_the_orchestrator(tmp_path: Path) -> None:
    toy = {"entrypoint": "skytether.testing.toy_service", "params": {"type": "object", "additionalProperties": True}}
    document = {"apiVersion": "skytether.io/v1", "kind": "Service", "metadata": {"name": "toy"}, "spec": toy}
    with house(tmp_path) as core:
        core.catalog.put("toy", Manifest.model_validate(document))
        asked = InstanceCreate(robot="walker", service="toy", lease_s=600, params={"report": "\x1b[31mhere"})
        made = core.instances.create(OPERATOR, asked, None).id
        assert until_told(core, made, "\\x1b[31mhere") == [("said", "\\x1b[31mhere")]
    (own,) = tmp_path.glob(f"sites/*/instances/{made}/own")
    second = {"number": 2, "code": "said", "message": "while nobody looked"}
    own.joinpath("reports.json").write_text(json.dumps({"reports": [{**second, "number": 1}, second]}))
    with house(tmp_path) as core:
        assert [reason for _, reason in until_told(core, made, "while nobody looked")] == [
            "\\x1b[31mhere",
            "while nobody looked",
        ]
        core.instances.delete(OPERATOR, made)
        while core.instances.get(OPERATOR, made).state is not State.STOPPED:
            time.sleep(0.05)
