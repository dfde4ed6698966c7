"""The acting part, step by step, with made-up time, a real store and runtimes that run nothing."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from reconcile_bench import add

from skytether.api.rest import State
from skytether.orchestrator.config.settings import Timing
from skytether.orchestrator.domain.overload import HOLD
from skytether.orchestrator.domain.records import Change, Record
from skytether.orchestrator.runtimes.base import Phase, SiteSilentError
from skytether.orchestrator.store.store import Store
from skytether.testing.runtimes import (
    BlockedRuntime,
    CrashingRuntime,
    FakeRuntime,
    NeverReadyRuntime,
    RefusingRuntime,
    SlowRuntime,
    StubbornRuntime,
)

NewRecord = Callable[..., Record]


def test_a_request_becomes_a_running_instance(bench: Any, new_record: NewRecord) -> None:
    b = bench()
    add(b, new_record())
    b.step(2)
    record = b.record()
    assert (record.state, record.site, record.host, record.port) == (State.RUNNING, "lab", "127.0.0.1", 40_000)
    assert [state for state, _ in b.reasons()] == ["pending", "placing", "starting", "running"]
    launch = b.runtime.world["i1"].launch
    assert launch.grant.session_id == record.session_id
    assert len(launch.grant.session_key) == 44
    assert launch.grant.session_key not in repr(launch)


def test_of_a_crowd_those_that_are_ready_do_not_wait_until_the_last_ones_are_started(
    bench: Any, new_record: NewRecord, monkeypatch: pytest.MonkeyPatch
) -> None:
    b = bench(SlowRuntime)
    b.step()
    start = b.runtime.start

    def takes_a_second(launch: Any) -> None:
        b.clock.forward(1.0)
        start(launch)

    monkeypatch.setattr(b.runtime, "start", takes_a_second)
    names = [f"i{number}" for number in range(45)]
    for name in names:
        add(b, new_record(name, lease_expires_at=b.clock() + 1000.0))
    b.placement.step()
    for _ in range(60):
        b.reconciler.site_step(b.site)
    assert {(b.record(name).state, b.record(name).attempt) for name in names} == {(State.RUNNING, 1)}
    waited = [(record := b.record(name)).running_at - record.started_at for name in names]
    assert max(waited) <= 10, "they were looked at meanwhile"


def test_a_crowd_is_placed_by_few_transactions_and_who_left_meanwhile_takes_no_room(
    bench: Any, new_record: NewRecord, monkeypatch: pytest.MonkeyPatch
) -> None:
    b = bench()
    names = [f"i{number}" for number in range(40)]
    for name in names:
        add(b, new_record(name))
    change_all, sizes = b.store.change_all, []

    def place(asked: Any, now: float) -> Any:
        sizes.append(len(asked))
        if sizes == [16]:
            change_all([Change(asked[3].record, {"state": State.STOPPED})], now)
        return change_all(asked, now)

    monkeypatch.setattr(b.store, "change_all", place)
    b.placement.step()
    assert sizes == [16, 16, 8]
    states = [b.record(name).state for name in names]
    assert (states.count(State.STARTING), states.count(State.STOPPED)) == (39, 1)
    assert b.placer.promised()["lab"].instances == 39


def test_looks_are_quick_while_something_changes_and_slow_when_not(bench: Any, new_record: NewRecord) -> None:
    b = bench(SlowRuntime)
    add(b, new_record())
    timing = Timing()
    assert b.step() == timing.observe_changing
    while b.record().state is not State.RUNNING:
        assert b.step() == timing.observe_changing
    assert b.step() == timing.observe


def test_a_site_that_is_seen_and_does_not_act_is_asked_again_a_second_later_and_not_for_all(
    bench: Any, new_record: NewRecord, monkeypatch: pytest.MonkeyPatch
) -> None:
    b = bench()
    names = [f"i{number}" for number in range(12)]
    for name in names:
        add(b, new_record(name))
    start, asked, unwell = b.runtime.start, [], set(names)

    def answer(launch: Any) -> None:
        asked.append(launch.instance)
        if launch.instance in unwell:
            raise SiteSilentError("the API server is busy or unwell")
        start(launch)

    monkeypatch.setattr(b.runtime, "start", answer)
    assert [b.step(), b.step()] == [Timing().place] * 2
    assert len(asked) == 2 * 5
    unwell -= set(names[4:])
    b.step(10)
    assert {b.record(name).state for name in names[:4]} == {State.STARTING}
    assert {(b.record(name).state, b.record(name).attempt) for name in names[4:]} == {(State.RUNNING, 1)}


def test_a_full_site_makes_it_wait_with_the_number_and_an_end_makes_room(bench: Any, new_record: NewRecord) -> None:
    b = bench(cpu=1)
    add(b, new_record("i1"))
    b.clock.forward(0.1)
    add(b, new_record("i2"))
    b.step(2)
    waiting = b.record("i2")
    assert waiting.state is State.PENDING
    assert waiting.reason == "waiting for a site: lab: needs 1 cores, 0 of 1 are free"
    b.step(3)
    assert len(b.reasons("i2")) == 2, "the same reason is told once"
    woken = b.woken
    b.store.change(Change(b.record("i1"), {"state": State.STOPPING, "stopping_at": b.clock()}), b.clock())
    b.step(4)
    assert b.woken > woken
    assert b.record("i2").state is State.RUNNING


def test_a_crash_is_mended_at_once_with_the_same_port_and_told(bench: Any, new_record: NewRecord) -> None:
    b = bench()
    add(b, new_record())
    b.step(2)
    port = b.record().port
    b.clock.forward(1)
    b.runtime.crash("i1", -9)
    b.step(3)
    record = b.record()
    assert (record.state, record.restarts, record.port, record.reason) == (State.RUNNING, 1, port, "")
    assert ("starting", "the service was killed by signal 9; starting it again") in b.reasons()
    assert b.runtime.started == [("i1", 1), ("i1", 2)]


def test_a_service_that_ends_at_once_is_given_up_with_its_last_line(bench: Any, new_record: NewRecord) -> None:
    b = bench(CrashingRuntime)
    add(b, new_record(lease_expires_at=b.clock() + 100))
    for _ in range(40):
        b.step()
        b.clock.forward(0.25)
    record = b.record()
    assert record.state is State.FAILED
    assert record.reason.startswith(
        'given up after 5 failures in a row: the service ended with exit status 1; its last line: "boom"; see '
    )
    assert b.runtime.started == [("i1", n) for n in range(1, 6)]
    assert b.runtime.observe()["i1"].phase is Phase.EXITED


def test_a_service_that_never_gets_ready_is_ended_and_tried_again(bench: Any, new_record: NewRecord) -> None:
    b = bench(NeverReadyRuntime)
    add(b, new_record(lease_s=1000, lease_expires_at=b.clock() + 1000))
    b.step()
    b.clock.forward(31)
    b.step(2)
    assert b.record().reason == "the service was not ready within 30 s; starting it again"
    assert b.runtime.observe()["i1"].exit_status == -9
    b.step()
    assert b.runtime.started == [("i1", 1), ("i1", 2)]


def test_a_site_that_cannot_start_it_fails_it_in_words(bench: Any, new_record: NewRecord) -> None:
    b = bench(RefusingRuntime)
    add(b, new_record(lease_expires_at=b.clock() + 100))
    for _ in range(40):
        b.step()
        b.clock.forward(0.25)
    assert b.record().state is State.FAILED
    assert "could not be started: no space left on the site" in b.record().reason


def test_whose_secret_key_is_gone_holds_up_no_other(bench: Any, new_record: NewRecord) -> None:
    b = bench()
    b.store.key_id = lambda: "00" * 16
    add(b, new_record("i1", lease_expires_at=b.clock() + 100))
    b.store.key_id = lambda: ""
    b.clock.forward(0.1)
    add(b, new_record("i2", lease_expires_at=b.clock() + 100))
    b.step(3)
    assert b.record("i2").state is State.RUNNING
    assert "is not in" in b.record("i1").reason
    for _ in range(40):
        b.step()
        b.clock.forward(0.25)
    assert b.record("i1").state is State.FAILED
    assert "the secret key 0000" in b.record("i1").reason
    assert "i1" not in b.runtime.world
    assert b.record("i1").refused == [], "no site is blamed"


NO_SPACE = "could not be started: no space left on the site"


def test_what_cannot_be_started_at_a_site_runs_at_another(bench: Any, new_record: NewRecord, tmp_path: Path) -> None:
    b = bench(RefusingRuntime)
    other = b.beside(tmp_path)
    add(b, new_record())
    b.step(3)
    b.reconciler.site_step(other)
    b.reconciler.site_step(other)
    record = b.record()
    assert (record.state, record.site, record.restarts) == (State.RUNNING, "other", 0)
    assert record.refused == [{"site": "lab", "reason": "start", "detail": NO_SPACE}]
    assert ("pending", f"site lab: the service {NO_SPACE}; trying another site") in b.reasons()
    assert other.runtime.started == [("i1", 3)]
    assert 'placement_refusals_total{reason="start",service="toy",site="lab"} 1.0' in b.metrics.text().decode()


def test_what_is_moved_does_not_go_where_it_could_not_be_started(
    bench: Any, new_record: NewRecord, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    b = bench(RefusingRuntime)
    other = b.beside(tmp_path)
    near = {"lab": {"rtt_ms": 5.0}, "other": {"rtt_ms": 300.0}}
    add(b, new_record(measurements=near, lease_expires_at=b.clock() + 1e9))
    b.step(3)
    b.reconciler.site_step(other)
    b.reconciler.site_step(other)
    assert b.record().site == "other"
    successors = b.successors
    monkeypatch.setattr(b.store, "reports", lambda _: {"i1": {"control_source": "fallback", "rtt_s": 0.3}})
    for _ in range(3):
        successors.watch(b.store.live())
        b.clock.forward(100)
    assert b.store.successor("i1") is None
    assert b.placer.weigh(successors.successor_of(b.record())).refused[0].reason == "start"
    assert b.placer.weigh(successors.successor_of(b.record(), "lab")).site == "lab", "the operator wants it"


def test_what_no_site_can_start_fails_with_all_reasons(bench: Any, new_record: NewRecord, tmp_path: Path) -> None:
    b = bench(RefusingRuntime)
    other = b.beside(tmp_path, RefusingRuntime)
    add(b, new_record(lease_expires_at=b.clock() + 100))
    for _ in range(40):
        b.step()
        b.reconciler.site_step(other)
        b.clock.forward(0.25)
    assert b.record().state is State.FAILED
    assert b.record().reason == f"no site can start it: lab: {NO_SPACE}; other: {NO_SPACE}"


def test_what_cannot_be_started_waits_for_a_site_that_is_full(
    bench: Any, new_record: NewRecord, tmp_path: Path
) -> None:
    b = bench(RefusingRuntime)
    other = b.beside(tmp_path, cpu=1)
    add(b, new_record("i1", pinned="other"))
    b.step()
    b.reconciler.site_step(other)
    add(b, new_record("i2", lease_expires_at=b.clock() + 100))
    for _ in range(40):
        b.step()
        b.clock.forward(0.25)
    waiting = b.record("i2")
    assert (waiting.state, waiting.site) == (State.PENDING, None)
    assert waiting.reason == f"waiting for a site: lab: {NO_SPACE}; other: needs 1 cores, 0 of 1 are free"


def test_a_standby_that_cannot_be_started_waits_for_no_room(
    bench: Any, new_record: NewRecord, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    b = bench(RefusingRuntime)
    other = b.beside(tmp_path, cpu=1)
    monkeypatch.setattr(b.standbys, "keep", lambda: None)
    add(b, new_record("i0", pinned="other", lease_expires_at=b.clock() + 1000))
    b.step()
    b.reconciler.site_step(other)
    add(b, new_record("i1", robot="", standby=True, lease_expires_at=b.clock() + 1e9))
    for _ in range(40):
        b.step()
        b.clock.forward(0.25)
    assert b.record().state is State.FAILED
    assert len(b.runtime.world) == 0


@pytest.mark.parametrize("silent", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_what_waits_tries_a_site_that_could_not_start_it_again(
    bench: Any, new_record: NewRecord, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, silent: bool
) -> None:
    b = bench(RefusingRuntime)
    other = b.beside(tmp_path, cpu=1)
    if not silent:
        add(b, new_record("i0", pinned="other", lease_expires_at=b.clock() + 1000))
        b.step()
    other.runtime.silent = silent
    b.reconciler.site_step(other)
    tried: list[float] = []
    real = b.runtime.start
    monkeypatch.setattr(b.runtime, "start", lambda launch: (tried.append(b.clock()), real(launch)))
    began = b.clock()
    add(b, new_record("i1", lease_expires_at=began + 1000))
    for _ in range(200):
        b.step()
        b.clock.forward(0.5)
    bursts = [at - began for before, at in zip([0.0, *tried], tried, strict=False) if at - before > 20]
    assert len(bursts) == 3, "in 100 s, each about 4 s long"
    assert len(tried) <= 5 * 3
    monkeypatch.setattr(b.runtime, "start", FakeRuntime.start.__get__(b.runtime))  # somebody mended it
    for _ in range(150):  # the pause after the third failure in a row is one of two minutes
        b.step()
        b.clock.forward(1)
    assert (b.record("i1").state, b.record("i1").site) == (State.RUNNING, "lab")


def test_nothing_is_placed_at_a_site_that_is_blocked_until_it_is_not(
    bench: Any, new_record: NewRecord, monkeypatch: pytest.MonkeyPatch
) -> None:
    b = bench(BlockedRuntime)
    add(b, new_record("i1", lease_expires_at=b.clock() + 100))
    monkeypatch.setattr(b.runtime, "blocked", lambda: "")  # it is placed before anybody knows
    b.step()
    monkeypatch.undo()
    add(b, new_record("i2", lease_expires_at=b.clock() + 100))
    for _ in range(40):
        b.step()
        b.clock.forward(0.25)
    for instance in ("i1", "i2"):
        assert b.record(instance).state is State.PENDING
        assert b.record(instance).reason == "waiting for a site: lab: the network is missing"
    b.runtime.obstacle = ""
    b.step(3)
    assert {b.record(instance).state for instance in ("i1", "i2")} == {State.RUNNING}


def test_what_runs_at_a_site_that_is_blocked_stays_as_good_as_it_was(
    bench: Any, new_record: NewRecord, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    b = bench(BlockedRuntime)
    b.runtime.obstacle = ""
    monkeypatch.setattr(b.standbys, "keep", lambda: None)
    add(b, new_record("i1", robot="", standby=True, lease_expires_at=b.clock() + 1e9))
    near = {"lab": {"rtt_ms": 5.0}, "other": {"rtt_ms": 300.0}}
    add(b, new_record("i2", measurements=near, lease_expires_at=b.clock() + 1e9))
    b.step(2)
    b.runtime.obstacle = "the network is missing"
    b.beside(tmp_path)
    successors = b.successors
    assert [standby.id for standby in b.standbys.fitting(new_record("i3", measurements=near))] == ["i1"]
    report = {"control_source": "fallback", "rtt_s": 0.005}
    monkeypatch.setattr(b.store, "reports", lambda _: {"i2": report})
    for _ in range(2):
        successors.watch(b.store.live())
        b.clock.forward(100)
    successors.watch(b.store.live())
    assert b.store.successor("i2") is None, "the other one is worse"


def test_a_robot_that_vanishes_frees_what_it_held(bench: Any, new_record: NewRecord) -> None:
    b = bench()
    add(b, new_record())
    b.step(2)
    b.clock.forward(15)
    b.step(3)
    assert (b.record().state, b.record().reason) == (State.STOPPED, "the robot did not renew its lease of 15 s")
    assert b.runtime.observe()["i1"].phase is Phase.EXITED


def test_a_robot_that_vanishes_before_there_was_a_site(bench: Any, new_record: NewRecord) -> None:
    b = bench(cpu=0.5)
    add(b, new_record())
    b.step()
    b.clock.forward(15)
    b.step()
    assert b.record().state is State.STOPPED


def test_a_stubborn_service_is_ended_by_force_after_the_grace(bench: Any, new_record: NewRecord) -> None:
    b = bench(StubbornRuntime)
    add(b, new_record())
    b.step(2)
    b.store.change(Change(b.record(), {"state": State.STOPPING, "stopping_at": b.clock()}), b.clock())
    b.clock.forward(4.9)
    b.step()
    assert b.record().state is State.STOPPING
    assert b.runtime.observe()["i1"].phase is Phase.RUNNING
    b.clock.forward(0.2)
    b.step(2)
    assert b.record().state is State.STOPPED


def test_a_silent_site_is_unreachable_and_what_runs_there_is_believed_to_run(bench: Any, new_record: NewRecord) -> None:
    b = bench()
    add(b, new_record())
    b.step(2)
    b.runtime.silent = True
    b.step()
    add(b, new_record("i2"))
    b.step()
    assert b.site.unreachable == "site lab does not answer"
    assert b.record("i1").state is State.RUNNING
    assert b.record("i2").reason == "waiting for a site: lab: site lab does not answer"
    b.runtime.silent = False
    b.step(3)
    assert b.site.unreachable == ""
    assert b.record("i2").state is State.RUNNING


def test_what_is_refused_to_an_overtaken_leader_is_no_fault_of_the_service(bench: Any, new_record: NewRecord) -> None:
    b = bench()
    b.runtime.lead(1)
    b.runtime.world.epoch = 2  # another one leads, and this one does not know yet
    add(b, new_record())
    b.step(4)
    record = b.record()
    assert (record.state, record.attempt, record.failures, record.reason) == (State.STARTING, 1, 0, "")
    assert b.runtime.started == []
    b.runtime.lead(3)
    b.step(2)
    assert b.record().state is State.RUNNING


def test_nobody_is_late_while_a_site_is_silent(bench: Any, new_record: NewRecord) -> None:
    b = bench(NeverReadyRuntime)
    add(b, new_record(lease_expires_at=b.clock() + 1000))
    b.step(2)
    b.runtime.silent = True
    b.step()
    b.clock.forward(100)
    b.runtime.silent = False
    b.step()
    b.clock.forward(29)
    b.step()
    assert b.record().restarts == 0
    b.clock.forward(2)
    b.step()
    assert b.record().restarts == 1


def test_a_restarted_orchestrator_adopts_what_runs(bench: Any, new_record: NewRecord, tmp_path: Path) -> None:
    b = bench()
    add(b, new_record())
    b.step(2)
    before = b.record()
    b.restart(tmp_path)
    b.step(3)
    assert b.record() == before
    assert b.runtime.started == []


def test_one_killed_right_after_a_launch_neither_starts_twice_nor_loses_it(
    bench: Any, new_record: NewRecord, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    b = bench()
    add(b, new_record())
    real, done = b.runtime.start, []

    def start_and_die(launch: Any) -> None:
        real(launch)
        done.append(launch)
        raise KeyboardInterrupt

    monkeypatch.setattr(b.runtime, "start", start_and_die)
    with pytest.raises(KeyboardInterrupt):
        b.step()
    b.restart(tmp_path)
    b.step(2)
    assert len(done) == 1
    assert b.runtime.started == []
    assert b.record().state is State.RUNNING


def test_what_died_while_the_orchestrator_was_down_is_started_again(
    bench: Any, new_record: NewRecord, tmp_path: Path
) -> None:
    b = bench()
    add(b, new_record())
    b.step(2)
    b.runtime.crash("i1", 1)
    b.restart(tmp_path)
    b.step(3)
    assert b.record().state is State.RUNNING
    assert b.runtime.started == [("i1", 2)]


def test_what_nobody_asked_for_is_removed_and_the_ended_is_kept_for_its_log(bench: Any, new_record: NewRecord) -> None:
    b = bench()
    add(b, new_record())
    b.step(2)
    b.runtime.world["stranger"] = b.runtime.world["i1"]
    b.store.change(Change(b.record(), {"state": State.STOPPING, "stopping_at": b.clock()}), b.clock())
    b.step(4)
    assert list(b.runtime.observe()) == ["i1"]
    assert b.runtime.logs("i1", 5)


def test_too_many_ended_ones_are_forgotten_with_what_is_left_of_them(bench: Any, new_record: NewRecord) -> None:
    b = bench()
    for name in ("i1", "i2"):
        add(b, new_record(name))
        b.step(2)
        b.clock.forward(1)
        b.store.change(Change(b.record(name), {"state": State.STOPPING, "stopping_at": b.clock()}), b.clock())
        b.step(3)
    b.clock.forward(61)
    b.step(2)
    assert [r.id for r in b.store.all()] == ["i2"]
    assert list(b.runtime.observe()) == ["i2"]


def test_a_change_by_somebody_else_in_between_wins(bench: Any, new_record: NewRecord, store: Store) -> None:
    b = bench()
    add(b, new_record())
    real = b.runtime.observe

    def deleted_meanwhile() -> Any:
        record = b.record()
        if record.state is State.STARTING:
            store.change(Change(record, {"state": State.STOPPING, "stopping_at": b.clock()}), b.clock())
        return real()

    b.runtime.observe = deleted_meanwhile
    b.step(3)
    assert b.record().state is State.STOPPED
    assert b.runtime.started == []


def test_starts_and_refusals_are_measured(bench: Any, new_record: NewRecord) -> None:
    b = bench(cpu=1)
    add(b, new_record())
    b.clock.forward(0.2)
    b.step()
    b.clock.forward(0.3)
    b.step()
    add(b, new_record("i2"))
    b.step(5)
    text = b.metrics.text().decode()
    labels = '{phase="total",service="toy",site="lab"}'
    assert f"skytether_instance_start_seconds_count{labels} 1.0" in text
    assert f"skytether_instance_start_seconds_sum{labels} 0.5" in text
    assert 'skytether_placement_refusals_total{reason="cpu",service="toy",site="lab"} 1.0' in text


@pytest.mark.parametrize(("state", "after"), [(State.STARTING, State.FAILED), (State.STOPPING, State.STOPPED)])
def test_what_was_placed_while_its_site_was_deleted_is_given_up(
    bench: Any, new_record: NewRecord, state: State, after: State
) -> None:
    b = bench()
    add(b, new_record())
    b.store.change(Change(b.record(), {"state": State.PLACING}), b.clock())
    b.store.change(Change(b.record(), {"state": State.STARTING, "site": "deleted"}), b.clock())
    if state is not State.STARTING:
        b.store.change(Change(b.record(), {"state": state}), b.clock())
    b.step()
    assert (b.record().state, b.record().reason) == (after, "site 'deleted' was deleted: ask again")


@pytest.mark.parametrize("standby", [False, True], ids=["at a site", "waiting for one"])
def test_while_robots_are_refused_no_lease_runs_out_and_then_all_count_anew(
    bench: Any, new_record: NewRecord, standby: bool
) -> None:
    b = bench()
    add(b, new_record("i0", pinned="nowhere" if standby else None))
    b.step(2)
    state = b.record("i0").state
    for _ in range(60):  # four leases long
        b.overload.note()
        b.clock.forward(1)
        b.step()
        assert b.record("i0").state is state
    b.clock.forward(HOLD)
    b.step(3)
    assert b.record("i0").state is state
    b.clock.forward(14)
    b.step(3)
    assert b.record("i0").state is state
    b.clock.forward(1.5)
    b.step(6)
    assert b.record("i0").state is State.STOPPED
