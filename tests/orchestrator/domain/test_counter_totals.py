"""Sums over all that counted, whatever is told twice, late, or not at all."""

from __future__ import annotations

import json
from pathlib import Path
from random import Random
from typing import Any

from skytether.api.rest import State
from skytether.orchestrator.domain.counter_totals import CounterTotals
from skytether.orchestrator.domain.records import Change
from skytether.orchestrator.store.store import Store

KEY = ("topic_messages", "scan", "64", "in", "sent")


def sent(account: CounterTotals) -> float:
    return account.sums().get(KEY, 0)


def test_a_report_that_comes_twice_or_late_changes_nothing() -> None:
    account = CounterTotals()
    for value in (10, 20, 20, 10, 30, 20):
        account.merge("robot:a", {KEY: value})
    assert sent(account) == 30


def test_a_program_that_is_started_anew_adds_to_what_was_counted_before() -> None:
    account = CounterTotals()
    account.merge("robot:a", {KEY: 1000})
    account.merge("robot:b", {KEY: 1500})  # more than the one before at its first report: no reset to be seen
    account.merge("robot:a", {KEY: 1010})  # a report that was on its way
    assert sent(account) == 2510


def test_no_sum_ever_goes_down_and_in_the_end_it_is_that_of_the_lives() -> None:
    random = Random(1)
    account, truth, before = CounterTotals(), {}, 0.0
    for life in range(30):
        counting = [random.randrange(1, 50) for _ in range(20)]
        told = [sum(counting[: n + 1]) for n in range(20)]
        truth[life] = told[-1]
        late = random.choices(told, k=8)
        last = [told[-1]]
        for value in [*told[:-1:3], *late, *last, *late]:
            account.merge(f"robot:{life}", {KEY: value})
            account = CounterTotals(json.loads(json.dumps(account.document())))
            assert sent(account) >= before
            before = sent(account)
    assert sent(account) == sum(truth.values())
    assert len(account.document()["lives"]) == 8


def test_names_beyond_the_room_are_refused_and_old_ones_go_on() -> None:
    account = CounterTotals()
    account.merge("robot:a", {KEY: 1})
    refused = [account.merge("robot:a", {("fallback_transitions", f"r{n}"): 1, KEY: n}) for n in range(600)]
    assert refused == [0] * 255 + [1] * 345
    assert len(account.names()) == len(account.sums()) == 256
    assert sent(account) == 599
    more = {("fallback_transitions", "r0"): 1, ("control_objections", "new"): 1, ("instance_restarts", "lab"): 3}
    account.merge("robot:b", more)
    assert account.sums()["fallback_transitions", "r0"] == 2
    assert account.sums()["instance_restarts", "lab"] == 3  # not of the robot's making
    assert len(account.sums()) == 257


def test_all_services_of_a_robot_share_its_names_also_over_a_restart(store: Store, tmp_path: Path) -> None:
    few = Store(f"sqlite:///{tmp_path}/state.db", robot_names=10)

    def hear(robot: str, first: int) -> int:
        told = {(robot, f"s{n}"): n for n in range(first, first + 4)}
        counted = {owner: [("robot:a", {("control_objections", f"r{n}"): 1})] for owner, n in told.items()}
        return few.keep_robot_reports({"i1": (1.0, {})}, counted)[robot]

    assert [hear("walker", first) for first in (0, 4, 8, 0)] == [0, 0, 2, 0]
    few.close()
    few = Store(f"sqlite:///{tmp_path}/state.db", robot_names=10)
    assert hear("walker", 12) == 4
    assert hear("other", 0) == 0
    few.close()


def test_the_store_keeps_accounts_as_long_as_an_instance_of_theirs(store: Store, new_record: Any) -> None:
    record = store.add(new_record(state=State.RUNNING), "robot:walker", None, "")
    now = record.created_at
    for value in (5, 4):
        store.keep_robot_reports({record.id: (now, {})}, {("walker", "toy"): [("robot:a", {KEY: value})]})
    store.count(record, [("run:i1:1", {("instance_cpu_seconds", "lab"): 2.5})])
    assert store.accounts()["walker", "toy"].sums() == {KEY: 5, ("instance_cpu_seconds", "lab"): 2.5}
    store.prune(now, ended_age=10, ended_count=10, events_count=10)
    assert ("walker", "toy") in store.accounts()
    assert store.get(record.id) is not None
    assert store.renew(record.id, now, None, robot="other") is None
    stopping = store.change(Change(record, {"state": State.STOPPING}), now)
    assert stopping is not None
    assert store.change(Change(stopping, {"state": State.STOPPED}), now)
    store.prune(now + 60, ended_age=10, ended_count=10, events_count=10)
    assert store.accounts() == {}
