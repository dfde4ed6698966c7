"""Robots' reports on their way into the database."""

from __future__ import annotations

from typing import Any

import pytest
from sqlalchemy.exc import OperationalError

from skytether.api.rest import State
from skytether.orchestrator.store.store import Store
from skytether.orchestrator.telemetry.reports import Reports

KEY = ("topic_messages", "/cmd_vel", "100", "in", "delivered")


def test_the_last_report_and_all_counts_of_a_moment_are_written_together(store: Store, new_record: Any) -> None:
    reports = Reports(store)
    mine, other = (store.add(new_record(i, robot=i, state=State.RUNNING), "", None, "") for i in ("mine", "other"))
    reports.add_report(mine, 1.0, {"load": 0.1}, "robot:a", {KEY: 10})
    reports.add_report(mine, 2.0, {"load": 0.2}, "robot:b", {KEY: 3})
    reports.add_report(other, 2.0, {"load": 0.3}, "robot:c", {KEY: 7})
    assert store.reports() == {}
    reports.write()
    assert store.reports() == {"mine": {"load": 0.2}, "other": {"load": 0.3}}
    assert {owner: account.sums() for owner, account in store.accounts().items()} == {
        ("mine", "toy"): {KEY: 13},
        ("other", "toy"): {KEY: 7},
    }


def test_what_cannot_be_written_is_kept_and_what_came_meanwhile_is_newer(
    store: Store, new_record: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    reports = Reports(store)
    record = store.add(new_record(state=State.RUNNING), "", None, "")
    reports.add_report(record, 1.0, {"load": 0.1}, "robot:a", {KEY: 10})

    def away(*_: Any) -> None:
        reports.add_report(record, 2.0, {"load": 0.2}, "robot:b", {KEY: 5})
        raise OperationalError("", None, Exception("the database is away"))

    with monkeypatch.context() as patch:
        patch.setattr(store, "keep_robot_reports", away)
        with pytest.raises(OperationalError):
            reports.write()
    reports.write()
    assert store.reports() == {record.id: {"load": 0.2}}
    assert store.accounts()["walker", "toy"].sums() == {KEY: 15}


def test_a_report_on_an_instance_that_was_forgotten_meanwhile_harms_nothing(store: Store, new_record: Any) -> None:
    reports = Reports(store)
    gone = new_record("gone", state=State.STOPPED)
    here = store.add(new_record("here", state=State.RUNNING), "", None, "")
    reports.add_report(gone, 1.0, {"load": 0.1}, "robot:a", {KEY: 10})
    reports.add_report(here, 1.0, {"load": 0.2}, "robot:a", {KEY: 12})
    reports.write()
    assert store.reports() == {"here": {"load": 0.2}}
    assert store.accounts()["walker", "toy"].sums() == {KEY: 12}


def test_many_are_written_in_parts_and_what_was_written_is_not_written_again(
    store: Store, new_record: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    reports = Reports(store)
    names = [f"robot-{n}" for n in range(250)]
    for name in names:
        record = store.add(new_record(name, robot=name, state=State.RUNNING), "", None, "")
        reports.add_report(record, 1.0, {"load": 0.1}, "robot:a", {KEY: 1})
    parts: list[int] = []
    hear = store.keep_robot_reports

    def failing(heard: Any, counted: Any) -> None:
        if len(parts) == 1:
            parts.append(0)
            raise OperationalError("", None, Exception("the database is away"))
        hear(heard, counted)
        parts.append(len(heard))

    monkeypatch.setattr(store, "keep_robot_reports", failing)
    with pytest.raises(OperationalError):
        reports.write()
    reports.write()
    assert parts == [100, 0, 100, 50]
    assert set(store.reports()) == set(names)


def test_an_orchestrator_that_was_cut_off_writes_over_nothing_newer(store: Store, new_record: Any) -> None:
    record = store.add(new_record(state=State.RUNNING), "", None, "")
    late, early = Reports(store), Reports(store)
    early.add_report(record, 1.0, {"load": 0.1}, "robot:a", {KEY: 1})
    late.add_report(record, 2.0, {"load": 0.2}, "robot:a", {KEY: 2})
    late.write()
    early.write()
    assert store.reports() == {record.id: {"load": 0.2}}
    assert store.accounts()["walker", "toy"].sums() == {KEY: 2}
