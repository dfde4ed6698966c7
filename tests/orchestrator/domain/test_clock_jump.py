"""The wall clock is set, forward and back by hours: nothing ends that should not, and nothing stays that should not."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from nothing_lost import assert_nothing_lost, processes, told
from orchestrator_program import PATIENCE, Program, until, with_toy
from reconcile_bench import Bench, add

from skytether.api.client import ApiError
from skytether.api.rest import InstanceCreate, Renew, State, TokenCreate
from skytether.orchestrator.config.settings import ServerLimits
from skytether.orchestrator.domain.clock_jump import ClockJump, SharedClock
from skytether.orchestrator.domain.records import Change, Record
from skytether.orchestrator.store.store import Store
from skytether.testing.runtimes import CrashingRuntime, NeverReadyRuntime

NewRecord = Callable[..., Record]
HOURS = 5 * 3600.0

either_way = pytest.mark.parametrize("by", [HOURS, -HOURS], ids=["forward", "back"])


def test_a_clock_that_was_set_is_told_from_one_that_goes_by() -> None:
    clock = ClockJump(1000, 10)
    assert clock.set_by(2000, 1010) == 0
    clock.accept(2000, 1010)
    assert clock.set_by(2005.9, 1015) == 0, "slewed"
    clock.accept(2005.9, 1015)
    assert clock.set_by(5605.9, 1015) == pytest.approx(3600)
    assert clock.set_by(5605.9, 1015) == pytest.approx(3600), "until it is accepted"
    clock.accept(5605.9, 1015)
    assert clock.set_by(2006.9, 1016) == pytest.approx(-3600)


@either_way
def test_leases_count_anew_and_who_vanishes_then_still_frees_what_he_held(
    bench: Any, new_record: NewRecord, by: float
) -> None:
    b: Bench = bench(cpu=1)
    add(b, new_record())
    b.step(2)
    add(b, new_record("waits"))
    b.step()
    b.clock.forward(10)
    b.clock.set_by(by)
    b.step(2)
    assert (b.record().state, b.record("waits").state) == (State.RUNNING, State.PENDING)
    b.clock.forward(2)  # by now every orchestrator knows
    b.step()
    b.clock.forward(14)
    b.step(2)
    assert (b.record().state, b.record("waits").state) == (State.RUNNING, State.PENDING)
    b.clock.forward(2)
    b.step(3)
    assert (b.record().state, b.record("waits").state) == (State.STOPPED, State.STOPPED)


@either_way
def test_a_start_and_an_end_get_their_time_and_no_more(bench: Any, new_record: NewRecord, by: float) -> None:
    b: Bench = bench(NeverReadyRuntime)
    add(b, new_record(lease_s=1000))
    b.step(2)
    b.clock.set_by(by)
    b.step(2)
    b.clock.forward(29)
    b.step()
    assert b.record().restarts == 0
    b.clock.forward(2)
    b.step()
    assert b.record().restarts == 1

    b.store.change(Change(b.record(), {"state": State.STOPPING, "stopping_at": b.clock()}), b.clock())
    b.runtime.obedient = False
    b.step()
    b.clock.set_by(by)
    b.step(2)
    b.clock.forward(4.9)
    b.step()
    assert b.record().state is State.STOPPING
    b.clock.forward(0.2)
    b.step(2)
    assert b.record().state is State.STOPPED


def test_a_back_off_of_another_clock_is_not_waited_for(bench: Any, new_record: NewRecord) -> None:
    b: Bench = bench(CrashingRuntime)
    add(b, new_record(lease_s=1000))
    while b.record().restarts < 2:
        b.step()
    b.clock.set_by(-HOURS)
    b.step(2)
    assert b.record().restarts == 3


@either_way
def test_ended_instances_are_kept_for_their_time_by_the_databases_clock_not_by_their_leaders(
    tmp_path: Path, store: Store, clock: Any, new_record: NewRecord, by: float
) -> None:
    """One that the leader ended, and one that another orchestrator ended, whose machine's clock is right."""
    shared: Any = SharedClock(clock, clock.steady, lambda: clock() + by)
    shared.sync()
    shared.steady = clock.steady
    b = Bench(tmp_path, store, shared)
    b.led_by(b.lead, ServerLimits())
    add(b, new_record())
    add(b, new_record("elsewhere", state=State.STOPPED))
    b.step(2)
    b.store.change(Change(b.record(), {"state": State.STOPPING, "stopping_at": shared()}), shared())
    b.step(2)
    clock.forward(ServerLimits().ended_age - 1)
    b.step()
    assert [b.record(name).state for name in ("i1", "elsewhere")] == [State.STOPPED] * 2, "neither too early"
    clock.forward(61)  # it looks once a minute
    b.step()
    assert [store.get(name) for name in ("i1", "elsewhere")] == [None] * 2, "nor too late"


class Faked:
    """The wall clock of programs that are started from now on; that of this machine is not touched."""

    def __init__(self, library: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self._offset = folder / "offset"
        self.set_by(0)
        for name, value in {
            "LD_PRELOAD": library,
            "FAKETIME_TIMESTAMP_FILE": str(self._offset),
            "FAKETIME_CACHE_DURATION": "1",  # seconds; without a cache each look at the clock reads the file
            "FAKETIME_DONT_FAKE_MONOTONIC": "1",
        }.items():
            monkeypatch.setenv(name, value)

    def set_by(self, seconds: float) -> None:
        """Against the right time."""
        draft = self._offset.with_suffix(".new")
        draft.write_text(f"{seconds:+.0f}")
        draft.replace(self._offset)


@pytest.mark.slow
def test_the_clock_of_a_machine_is_set_under_an_orchestrator(
    faketime: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, manifest: Any
) -> None:
    faked = Faked(faketime, tmp_path, monkeypatch)
    (tmp_path / "one").mkdir()
    program = Program(tmp_path / "one" / "state")
    runs = processes(program.folder)
    try:
        with with_toy(program.start(), manifest) as client:
            made = client.wait_running(
                client.create_instance(InstanceCreate(robot="w", service="toy", lease_s=60)).id, PATIENCE
            )
            at_work = runs()
            asked = TokenCreate(name="short", scopes=("read",), ttl_s=3600)
            with program.client(client.create_token(asked).token) as reader:
                for number, (by, good) in enumerate([(HOURS, False), (-HOURS, True)], start=1):
                    faked.set_by(by)
                    until(lambda n=number: program.log.count("leases and waits count anew") == n, program)
                    if good:
                        assert reader.get_instance(made.id).state is State.RUNNING
                    else:
                        with pytest.raises(ApiError, match="expired"):
                            reader.get_instance(made.id)
                    assert_nothing_lost(told(client), {made.id: State.RUNNING}, runs)
                    left = client.get_instance(made.id).lease_expires_at.timestamp() - time.time() - by
                    assert 0 < left <= 61
            assert runs() == at_work
            assert client.get_instance(made.id).restarts == 0
            client.renew_instance(made.id, Renew(lease_s=1))
            assert_nothing_lost(told(client), {made.id: State.STOPPED}, runs)
    except Exception as error:
        raise AssertionError(program.last_words()) from error
    finally:
        program.clean_up()
