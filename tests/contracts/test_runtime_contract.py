"""What every runtime must do: the words of ``skytether.orchestrator.runtimes.base``, as tests."""

from __future__ import annotations

import time
from typing import Any

import pytest

from skytether.api.manifest import ServiceSpec
from skytether.orchestrator.runtimes.base import Phase, RuntimeFailure

Kit = Any


def test_a_site_offers_something(kit: Kit) -> None:
    capacity = kit.open().capacity()
    assert capacity.cpu > 0
    assert capacity.memory_mb > 0
    assert capacity.gpu >= 0


def test_it_says_why_it_cannot_run_a_service(kit: Kit) -> None:
    runtime = kit.open()
    assert runtime.refuses(kit.launch().spec) is None
    either = [runtime.refuses(ServiceSpec(image="x")), runtime.refuses(ServiceSpec(entrypoint="x"))]
    assert any(reason for reason in either)


def test_an_empty_site_has_nothing(kit: Kit) -> None:
    assert kit.open().observe() == {}


def test_a_run_gets_ready_and_says_where_it_listens(kit: Kit) -> None:
    runtime = kit.open()
    runtime.start(kit.launch())
    seen = kit.until(runtime, Phase.RUNNING)
    assert seen.attempt == 1
    assert seen.host
    assert 0 < seen.port < 65536
    assert seen.exit_status is None
    assert seen.memory_bytes is None or seen.memory_bytes > 0
    assert seen.cpu_s is None or seen.cpu_s >= 0


def test_starting_the_same_attempt_again_changes_nothing(kit: Kit) -> None:
    runtime = kit.open()
    runtime.start(kit.launch())
    before = kit.until(runtime, Phase.RUNNING)
    runtime.start(kit.launch())
    after = kit.until(runtime, Phase.RUNNING)
    assert (after.attempt, after.port) == (before.attempt, before.port)
    assert runtime.logs("i1", 100).count("run 1") == 1


def test_two_instances_do_not_meddle(kit: Kit) -> None:
    runtime = kit.open()
    runtime.start(kit.launch("i1"))
    runtime.start(kit.launch("i2"))
    first, second = kit.until(runtime, Phase.RUNNING, "i1"), kit.until(runtime, Phase.RUNNING, "i2")
    assert (first.host, first.port) != (second.host, second.port)
    runtime.stop("i1", force=True)
    kit.until(runtime, Phase.EXITED, "i1")
    assert runtime.observe()["i2"].phase is Phase.RUNNING


def test_a_run_ends_when_it_is_asked_to_also_when_asked_again(kit: Kit) -> None:
    runtime = kit.open()
    runtime.start(kit.launch())
    kit.until(runtime, Phase.RUNNING)
    for _ in range(3):
        runtime.stop("i1", force=False)
    seen = kit.until(runtime, Phase.EXITED)
    assert seen.exit_status in (0, None)
    runtime.stop("i1", force=False)
    runtime.stop("i1", force=True)
    assert kit.until(runtime, Phase.EXITED) == seen


def test_a_stubborn_run_ends_by_force_only(kit: Kit) -> None:
    runtime = kit.open("stubborn")
    runtime.start(kit.launch(behaviour="stubborn"))
    kit.until(runtime, Phase.RUNNING)
    runtime.stop("i1", force=False)
    assert runtime.observe()["i1"].phase is Phase.RUNNING
    runtime.stop("i1", force=True)
    seen = kit.until(runtime, Phase.EXITED)
    assert seen.exit_status is None or seen.exit_status != 0


def test_a_run_that_ends_by_itself_says_how(kit: Kit) -> None:
    runtime = kit.open("crashing")
    runtime.start(kit.launch(behaviour="crashing"))
    seen = kit.until(runtime, Phase.EXITED)
    assert seen.exit_status in (1, None)
    assert seen.last_line == "boom"
    assert "boom" in runtime.logs("i1", 10)


def test_an_ended_run_is_seen_until_it_is_removed(kit: Kit) -> None:
    runtime = kit.open("crashing")
    runtime.start(kit.launch(behaviour="crashing"))
    seen = kit.until(runtime, Phase.EXITED)
    assert [runtime.observe()["i1"] for _ in range(3)] == [seen] * 3
    runtime.remove("i1")
    runtime.remove("i1")
    assert runtime.observe() == {}
    assert runtime.logs("i1", 10) == ""


def test_some_are_looked_at_as_all_are(kit: Kit) -> None:
    runtime = kit.open()
    for instance in ("i1", "i2"):
        runtime.start(kit.launch(instance))
    for instance in ("i1", "i2"):
        kit.until(runtime, Phase.RUNNING, instance)
    seen = runtime.look_at({"i2", "nobody"})
    assert list(seen) == ["i2"]
    assert (seen["i2"].phase, seen["i2"].port) == (Phase.RUNNING, runtime.observe()["i2"].port)
    assert runtime.look_at(()) == {}
    runtime.stop("i2", force=True)
    deadline = time.monotonic() + kit.patience
    while runtime.look_at(["i2"])["i2"].phase is not Phase.EXITED:
        assert time.monotonic() < deadline
        time.sleep(0.005)


def test_the_next_attempt_takes_the_place_of_the_last_and_keeps_its_port_and_log(kit: Kit) -> None:
    runtime = kit.open()
    runtime.start(kit.launch(attempt=1))
    port = kit.until(runtime, Phase.RUNNING).port
    runtime.stop("i1", force=True)
    kit.until(runtime, Phase.EXITED)
    runtime.start(kit.launch(attempt=2))
    seen = kit.until(runtime, Phase.RUNNING)
    assert (seen.attempt, seen.port) == (2, port)
    assert "run 1" in runtime.logs("i1", 100)
    assert "run 2" in runtime.logs("i1", 100)
    assert "run 1" not in runtime.logs("i1", 1)


def test_the_next_attempt_ends_what_is_left_of_the_last(kit: Kit) -> None:
    runtime = kit.open("stubborn")
    runtime.start(kit.launch(attempt=1, behaviour="stubborn"))
    kit.until(runtime, Phase.RUNNING)
    runtime.start(kit.launch(attempt=2, behaviour="stubborn"))
    assert kit.until(runtime, Phase.RUNNING).attempt == 2
    assert len(runtime.observe()) == 1


def test_removing_ends_what_runs(kit: Kit) -> None:
    runtime = kit.open("stubborn")
    runtime.start(kit.launch(behaviour="stubborn"))
    kit.until(runtime, Phase.RUNNING)
    runtime.remove("i1")
    assert runtime.observe() == {}
    assert kit.open().observe() == {}


def test_what_nobody_knows_is_no_error(kit: Kit) -> None:
    runtime = kit.open()
    runtime.stop("nobody", force=False)
    runtime.stop("nobody", force=True)
    runtime.remove("nobody")
    assert runtime.logs("nobody", 10) == ""


def test_a_run_outlives_its_runtime_and_is_adopted_by_the_next(kit: Kit) -> None:
    first = kit.open()
    first.start(kit.launch())
    before = kit.until(first, Phase.RUNNING)
    first.close()
    second = kit.open()
    after = second.observe()["i1"]
    assert (after.attempt, after.phase, after.port) == (before.attempt, Phase.RUNNING, before.port)
    second.start(kit.launch())  # of the same attempt: nothing to do
    assert second.logs("i1", 100).count("run 1") == 1
    second.stop("i1", force=False)
    assert kit.until(second, Phase.EXITED).attempt == 1


def test_an_end_is_remembered_by_the_next_runtime(kit: Kit) -> None:
    first = kit.open("crashing")
    first.start(kit.launch(behaviour="crashing"))
    kit.until(first, Phase.EXITED)
    first.close()
    seen = kit.open().observe()["i1"]
    assert (seen.attempt, seen.phase, seen.last_line) == (1, Phase.EXITED, "boom")


def test_looking_changes_nothing(kit: Kit) -> None:
    runtime = kit.open()
    runtime.start(kit.launch())
    kit.until(runtime, Phase.RUNNING)
    looks = [runtime.observe()["i1"] for _ in range(5)]
    assert {(look.phase, look.port, look.attempt) for look in looks} == {(Phase.RUNNING, looks[0].port, 1)}


@pytest.mark.parametrize("force", [False, True])
def test_stopping_what_is_not_ready_yet(kit: Kit, force: bool) -> None:
    runtime = kit.open()
    runtime.start(kit.launch())
    runtime.stop("i1", force=force)
    kit.until(runtime, Phase.EXITED)


def test_tidying_is_always_possible(kit: Kit) -> None:
    runtime = kit.open()
    runtime.tidy()
    runtime.start(kit.launch())
    runtime.tidy()
    kit.until(runtime, Phase.RUNNING)


def test_what_a_run_reports_is_seen_and_the_next_run_begins_anew(kit: Kit) -> None:
    runtime = kit.open()
    for attempt in (1, 2):
        runtime.start(kit.launch(attempt=attempt))
        deadline = time.monotonic() + kit.patience
        while not (seen := kit.until(runtime, Phase.RUNNING)).reports:
            assert time.monotonic() < deadline, seen
            runtime.tidy()
            time.sleep(0.05)
        assert [(r.number, r.code, r.message) for r in seen.reports] == [(1, "said", f"run {attempt} is up")]


def test_what_a_run_may_take_is_changed_while_it_runs_or_refused_as_told(kit: Kit) -> None:
    runtime = kit.open()
    launch = kit.launch()
    runtime.start(launch)
    before = kit.until(runtime, Phase.RUNNING)
    has = launch.spec.needs
    larger, keeps = launch.spec.sized(2 * has.cpu, 2 * has.memory_mb), runtime.keeps_size(launch.spec)
    if keeps:
        with pytest.raises(RuntimeFailure):
            runtime.resize("i1", 1, larger)
        return
    assert not runtime.resize("i1", 2, larger), "of another run"
    assert not runtime.resize("nobody", 1, larger)
    for spec in (larger, larger, launch.spec, launch.spec):
        deadline = time.monotonic() + kit.patience
        while not runtime.resize("i1", 1, spec):
            assert time.monotonic() < deadline
            time.sleep(0.01)
    after = kit.until(runtime, Phase.RUNNING)
    assert (after.attempt, after.port) == (before.attempt, before.port)
    assert runtime.logs("i1", 100).count("run 1") == 1
    assert kit.running() == 1
