from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from skytether.api.rest import Refusal, Score, Size, State
from skytether.orchestrator.domain import transitions
from skytether.orchestrator.domain.records import Change, IllegalMoveError, Record

NOW = 1_700_000_000.0
REFUSED = (Refusal(site="b", reason="full", detail="0 of 2 cores are free"),)
SCORES = (Score(site="a", rtt_ms=3.0, compute_ms=0, queue_ms=0, cost_ms=0, spread_ms=0, measured=True),)
NewRecord = Callable[..., Record]


def drafted(change: Change) -> Record:
    return change.draft(NOW)[0]


def test_a_start_at_a_site_and_a_crash_there(new_record: NewRecord) -> None:
    chosen = drafted(transitions.starting(new_record(), "a", SCORES, REFUSED))
    assert (chosen.state, chosen.site, chosen.refused[0]["site"]) == (State.STARTING, "a", "b")
    begun = drafted(transitions.launched(chosen, NOW))
    ready = drafted(transitions.running(begun, NOW + 1, "h", 4000))
    assert (ready.state, ready.host, ready.port, ready.running_at) == (State.RUNNING, "h", 4000, NOW + 1)
    assert drafted(transitions.running(ready, NOW + 9, "h", 4001)).running_at == NOW + 1, "it runs since then"
    again = drafted(transitions.restarting(ready, 1, NOW + 2, "the service ended"))
    assert (again.state, again.attempt, again.restarts, again.started_at, again.site) == (
        *(State.STARTING, ready.attempt + 1, 1, None, "a"),
    )


@pytest.mark.parametrize("make", [transitions.displaced, lambda r, why: transitions.unstarted(r, 2, NOW, why, REFUSED)])
def test_what_is_placed_anew_is_at_no_site(new_record: NewRecord, make: Callable[[Record, str], Change]) -> None:
    there = new_record(state=State.STARTING, site="a", host="h", port=1, started_at=NOW)
    lost = drafted(make(there, "gone"))
    assert (lost.state, lost.site, lost.host, lost.port, lost.started_at) == (State.PENDING, None, None, None, None)


def test_what_runs_and_is_lost_with_its_site_passes_through_starting(new_record: NewRecord) -> None:
    _, _, told = transitions.displaced(new_record(state=State.RUNNING, site="a"), "gone").draft(NOW)
    assert [record.state for record in told] == [State.STARTING, State.PENDING]


def test_what_has_no_site_has_ended_when_it_is_to_end(new_record: NewRecord) -> None:
    assert transitions.stopping(new_record(), NOW, "").state is State.STOPPED
    at_a_site = new_record(state=State.RUNNING, site="a")
    assert transitions.stopping(at_a_site, NOW, "").state is State.STOPPING


def test_with_the_size_it_had_or_what_its_manifest_says(new_record: NewRecord) -> None:
    large: dict[str, Any] = {"cpu": 3.0, "memory_mb": 900}
    record = new_record(size=large)
    assert drafted(transitions.starting(record, "a", SCORES, ())).size == large
    change = transitions.starting(record, "a", SCORES, (), "has less")
    new, _, told = change.draft(NOW)
    assert new.size is None
    assert told[-1].reason == "has less"


def test_a_standby_that_takes_over_is_to_have_what_the_other_had(new_record: NewRecord) -> None:
    standby = new_record("i2", state=State.RUNNING, standby=True, robot="")
    wanted = new_record("i3", replaces="i1", size=Size(cpu=3.0, memory_mb=900).model_dump())
    taken = drafted(transitions.takes_over(standby, wanted, NOW))
    assert (taken.robot, taken.standby, taken.replaces, taken.wants) == (
        *(wanted.robot, False, "i1", Size(cpu=3.0, memory_mb=900)),
    )


def test_no_name_allows_a_move_that_is_not_in_the_table(new_record: NewRecord) -> None:
    over = new_record(state=State.STOPPED)
    for change in (
        transitions.running(over, NOW, None, None),
        transitions.waiting(over, "", ()),
        transitions.failed(over, ""),
    ):
        with pytest.raises(IllegalMoveError):
            change.draft(NOW)
