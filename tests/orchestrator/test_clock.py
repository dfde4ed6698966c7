"""The wall clock is set, forward and back by hours: nothing ends that should not, and nothing stays that should not."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from reconcile_bench import Bench, add

from skytether.api.rest import State
from skytether.orchestrator.clocks import SetClock
from skytether.orchestrator.records import Record
from skytether.testing.runtimes import CrashingRuntime, NeverReadyRuntime

NewRecord = Callable[..., Record]
HOURS = 5 * 3600.0

either_way = pytest.mark.parametrize("by", [HOURS, -HOURS], ids=["forward", "back"])


def test_a_clock_that_was_set_is_told_from_one_that_goes_by() -> None:
    clock = SetClock(1000, 10)
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

    b.store.change(b.record(), b.clock(), state=State.STOPPING, stopping_at=b.clock())
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
