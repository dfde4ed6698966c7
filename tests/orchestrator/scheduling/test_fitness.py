"""A site that failed to start a service gets no more of it for a while, for whichever instance."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from reconcile_bench import add

from skytether.api.rest import State
from skytether.orchestrator.domain.records import Record
from skytether.orchestrator.scheduling.fitness import Fitness
from skytether.testing.runtimes import CrashingRuntime, FakeRuntime, RefusingRuntime

NewRecord = Callable[..., Record]
BOOM = 'ended with exit status 1; its last line: "boom"'
NOON = 1_784_894_400.0
"""12:00:00 UTC."""


@pytest.fixture
def fitness() -> Fitness:
    return Fitness(first_s=30, most_s=300)


def fail(fitness: Fitness, record: Record, now: float) -> None:
    fitness.failed(record, BOOM, now, NOON + now)


def test_the_time_doubles_with_each_failure_in_a_row_and_ends_with_a_start(
    fitness: Fitness, new_record: NewRecord
) -> None:
    record, now = new_record(), 0.0
    for wait in (30, 60, 120, 240, 300, 300):
        fail(fitness, record, now)
        assert fitness.objection(record, now + wait - 0.1)
        assert fitness.objection(record, now + wait) is None
        now += wait
    fitness.started(record)
    fail(fitness, record, now)
    assert fitness.objection(record, now + 30) is None
    assert [verdict.failures for verdict in fitness.verdicts(now)] == [1]


def test_failures_under_way_together_count_once(fitness: Fitness, new_record: NewRecord) -> None:
    for number in range(8):
        fail(fitness, new_record(f"i{number}", robot=f"r{number}"), number * 0.1)
    assert [(v.failures, v.until) for v in fitness.verdicts(1.0)] == [(1, 30.0)]


def test_of_one_robot_the_parameters_may_be_at_fault_so_the_others_may_try(
    fitness: Fitness, new_record: NewRecord
) -> None:
    one, two, three, standby = (new_record(name, robot=name) for name in ("one", "two", "three", ""))
    fail(fitness, standby, 0)
    assert fitness.objection(one, 0) is None
    fail(fitness, one, 0)
    assert fitness.objection(one, 0) == f"cannot start it: the service {BOOM}; tried again at 12:00:30 UTC"
    assert fitness.objection(standby, 0)
    assert fitness.objection(two, 0) is None
    fail(fitness, two, 1)
    assert fitness.objection(three, 1) == "cannot start it: it failed for other robots; tried again at 12:00:30 UTC"


def test_when_the_time_is_over_one_tries_and_the_others_wait_for_what_comes_of_it(
    fitness: Fitness, new_record: NewRecord
) -> None:
    one, two = new_record("one", robot="one"), new_record("two", robot="two")
    fail(fitness, one, 0)
    fail(fitness, two, 0)
    fitness.placed(one, 30, NOON + 30)
    assert fitness.objection(two, 31)
    assert fitness.objection(two, 60) is None, "the start takes too long to wait for"
    fail(fitness, one, 32)
    assert fitness.objection(two, 91)
    fitness.placed(one, 92, NOON + 92)
    fitness.started(one)
    assert fitness.objection(two, 92) is None


def test_a_changed_manifest_is_not_judged_by_the_old_one(fitness: Fitness, new_record: NewRecord) -> None:
    before = new_record()
    mended = new_record(manifest={**before.manifest, "spec": {**before.manifest["spec"], "entrypoint": "toys.mended"}})
    fail(fitness, before, 0)
    assert fitness.objection(mended, 0) is None
    fitness.started(mended)
    assert fitness.objection(before, 0), "that another one starts says nothing of it"


def test_what_is_remembered_is_bounded(fitness: Fitness, new_record: NewRecord) -> None:
    for number in range(300):
        fail(fitness, new_record(service=f"toy-{number}"), 0)
    assert len(fitness.verdicts(0)) == 256


def run(b: Any, *others: Any, seconds: float) -> None:
    for _ in range(round(seconds / 0.25)):
        b.step()
        for site in others:
            b.reconciler.site_step(site)
        b.clock.forward(0.25)


def test_what_ends_at_once_at_a_site_runs_at_another_and_so_do_all_that_follow(
    bench: Any, new_record: NewRecord, tmp_path: Path
) -> None:
    b = bench(CrashingRuntime)
    other = b.beside(tmp_path)
    for number in range(8):
        add(b, new_record(f"i{number}", robot=f"r{number}", lease_expires_at=b.clock() + 1000))
        run(b, other, seconds=2)
    assert {b.record(f"i{number}").state for number in range(8)} == {State.RUNNING}
    assert {b.record(f"i{number}").site for number in range(8)} == {"other"}
    assert len(b.runtime.started) == 4, "two runs of the first two robots' each"
    assert b.record("i0").refused == [{"site": "lab", "reason": "start", "detail": BOOM}]
    assert [refusal["reason"] for refusal in b.record("i7").refused] == ["unfit"]
    assert b.runtime.observe()["i0"].exit_status == 1
    shown = b.site.fitness.verdicts(b.clock.steady())
    assert [(v.service, v.why, v.failures, len(v.robots)) for v in shown] == [("toy", BOOM, 1, 2)]


def test_a_mended_site_is_tried_by_one_instance_and_then_runs_what_waits(
    bench: Any, new_record: NewRecord, monkeypatch: pytest.MonkeyPatch
) -> None:
    b = bench(RefusingRuntime)
    for number in range(2):
        add(b, new_record(f"i{number}", robot=f"r{number}", lease_expires_at=b.clock() + 1000))
    run(b, seconds=6)
    for number in range(2, 5):
        add(b, new_record(f"i{number}", robot=f"r{number}", lease_expires_at=b.clock() + 1000))
    run(b, seconds=5)
    waiting = b.record("i4")
    assert waiting.state is State.PENDING
    assert waiting.reason.startswith(
        "waiting for a site: lab: cannot start it: it failed for other robots; tried again"
    )
    assert len(b.reasons("i4")) == 2, "asked for, and told once why it waits"
    monkeypatch.setattr(b.runtime, "start", FakeRuntime.start.__get__(b.runtime))
    run(b, seconds=30)
    assert {b.record(f"i{number}").state for number in range(2, 5)} == {State.RUNNING}


def test_who_names_a_site_gets_it_and_one_that_runs_there_is_good_enough(bench: Any, new_record: NewRecord) -> None:
    b = bench()
    fail(b.site.fitness, new_record(), b.clock.steady())
    record = new_record()
    assert b.placer.weigh(record).site is None
    assert b.placer.weigh(record, {}, runs=True).site == "lab"
    assert b.placer.weigh(new_record(pinned="lab")).site == "lab"


def test_who_leads_anew_holds_nothing_against_a_site(
    bench: Any, new_record: NewRecord, monkeypatch: pytest.MonkeyPatch
) -> None:
    b = bench()
    fail(b.site.fitness, new_record(), b.clock.steady())
    b.reconciler.site_step(b.site)
    assert b.site.fitness.verdicts(b.clock.steady())
    monkeypatch.setattr(b.reconciler, "_lead", SimpleNamespace(leads=True, epoch=7))
    b.reconciler.site_step(b.site)
    assert b.site.fitness.verdicts(b.clock.steady()) == []
