from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skytether.api.pull_progress import PullProgress
from skytether.api.rest import State
from skytether.orchestrator.config.settings import Timing
from skytether.orchestrator.domain.records import MOVES, IllegalMoveError, Record, check_move
from skytether.orchestrator.runtimes.base import Observation, Phase
from skytether.orchestrator.scheduling.plan import (
    Action,
    Crash,
    End,
    Expire,
    Place,
    Progress,
    Ready,
    Remove,
    Start,
    Stop,
    after_crash,
    backoff,
    decide,
    how_it_ended,
    plan,
)

T = Timing()
NewRecord = Callable[..., Record]
NOW = 1_700_000_000.0


def seen(phase: Phase, attempt: int = 1, **more: Any) -> Observation:
    return Observation(attempt, phase, **more)


STARTING, EXITED = seen(Phase.STARTING), seen(Phase.EXITED, exit_status=1, last_line="boom")
RUNNING = seen(Phase.RUNNING, host="127.0.0.1", port=4000)


def at_site(new_record: NewRecord, state: State, **more: Any) -> Record:
    return new_record(state=state, site="lab", **more)


def test_what_has_no_site_is_placed_until_its_lease_ends(new_record: NewRecord) -> None:
    for state in (State.PENDING, State.PLACING):
        record = new_record(state=state)
        assert decide(record, None, NOW, T) == Place(record)
        assert decide(record, None, NOW + 15, T) == Expire(record)


def test_a_start_waits_for_its_time(new_record: NewRecord) -> None:
    record = at_site(new_record, State.STARTING, start_at=NOW + 2)
    assert decide(record, None, NOW + 1.9, T) is None
    assert decide(record, None, NOW + 2, T) == Start(record)


def test_a_start_is_begun_once_and_becomes_ready(new_record: NewRecord) -> None:
    record = at_site(new_record, State.STARTING, started_at=NOW)
    assert decide(record, STARTING, NOW + 1, T) is None
    assert decide(record, RUNNING, NOW + 1, T) == Ready(record, "127.0.0.1", 4000)
    assert decide(record, None, NOW + 1, T) == Start(record)  # the call got lost


def test_a_start_that_takes_too_long_is_a_crash(new_record: NewRecord) -> None:
    record = at_site(new_record, State.STARTING, started_at=NOW - 30.1)
    assert decide(record, STARTING, NOW, T) == Crash(record, "was not ready within 30 s")


def test_one_of_which_nothing_ran_meanwhile_says_what_it_waited_for_and_may_go_elsewhere(new_record: NewRecord) -> None:
    waits = "no node takes it: 0/1 nodes are available: 1 Insufficient cpu."
    record = at_site(new_record, State.STARTING, started_at=NOW - 30.1, reason=waits)
    waiting = Observation(record.attempt, Phase.STARTING, detail=waits, unstarted=True)
    assert decide(record, waiting, NOW, T) == Crash(record, f"was not ready within 30 s: {waits}", unstarted=True)


def test_a_service_that_does_not_like_its_grant_is_not_tried_again(new_record: NewRecord) -> None:
    record = at_site(new_record, State.STARTING, started_at=NOW)
    action = decide(record, seen(Phase.EXITED, exit_status=2, last_line="mass: must be above 0"), NOW, T)
    assert isinstance(action, Crash)
    change = after_crash(action, NOW, T)
    assert change.state is State.FAILED
    assert 'exit status 2; its last line: "mass: must be above 0"; correct' in change.after.reason
    # After it has run, the same status says nothing of the grant.
    ran = at_site(new_record, State.RUNNING)
    action = decide(ran, seen(Phase.EXITED, exit_status=2), NOW, T)
    assert isinstance(action, Crash)
    assert after_crash(action, NOW, T).state is State.STARTING


def test_what_runs_is_left_alone_unless_it_moved(new_record: NewRecord) -> None:
    record = at_site(new_record, State.RUNNING, host="127.0.0.1", port=4000)
    assert decide(record, RUNNING, NOW, T) is None
    assert decide(dataclasses.replace(record, port=1), RUNNING, NOW, T) == Ready(
        dataclasses.replace(record, port=1), "127.0.0.1", 4000
    )


def test_what_ended_or_vanished_crashed(new_record: NewRecord) -> None:
    record = at_site(new_record, State.RUNNING)
    assert decide(record, EXITED, NOW, T) == Crash(record, 'ended with exit status 1; its last line: "boom"')
    assert decide(record, None, NOW, T) == Crash(record, "is gone")


def test_an_end_of_an_earlier_run_is_no_news(new_record: NewRecord) -> None:
    record = at_site(new_record, State.STARTING, attempt=2, start_at=NOW + 1)
    assert decide(record, EXITED, NOW, T) is None
    assert decide(record, EXITED, NOW + 1, T) == Start(record)


def test_what_is_left_of_an_earlier_run_is_ended_before_the_next(new_record: NewRecord) -> None:
    record = at_site(new_record, State.STARTING, attempt=2)
    assert decide(record, STARTING, NOW, T) == Stop(record.id, force=True)


def test_stopping_asks_then_forces_then_ends(new_record: NewRecord) -> None:
    record = at_site(new_record, State.STOPPING, stopping_at=NOW)
    assert decide(record, RUNNING, NOW + 4.9, T) == Stop(record.id, force=False)
    assert decide(record, RUNNING, NOW + 5, T) == Stop(record.id, force=True)
    assert decide(record, EXITED, NOW + 1, T) == End(record)
    assert decide(record, None, NOW + 1, T) == End(record)


def test_strangers_are_removed_and_the_ended_do_not_live_on(new_record: NewRecord) -> None:
    observed = {"stranger": RUNNING, "old": EXITED, "undead": RUNNING}
    assert plan([], observed, {"old", "undead"}, NOW, T) == [Remove("stranger"), Stop("undead", force=True)]
    final = at_site(new_record, State.FAILED)
    assert decide(final, RUNNING, NOW, T) == Stop(final.id, force=True)
    assert decide(final, EXITED, NOW, T) is None


def test_back_off_doubles_up_to_its_bound() -> None:
    assert [backoff(n, T) for n in range(1, 7)] == [0, 0.5, 1, 2, 4, 8]
    assert backoff(1_000_000, T) == 30


def test_quick_failures_in_a_row_are_given_up_and_a_long_run_starts_the_count_again(new_record: NewRecord) -> None:
    record, waits = at_site(new_record, State.STARTING), []
    while record.state is not State.FAILED:
        record = after_crash(Crash(record, "ended"), NOW, T).after
        waits.append(record.start_at - NOW)
    assert record.restarts == 4
    assert waits == [0, 0.5, 1, 2, 2]
    assert record.reason == "given up after 5 failures in a row: the service ended; see `skytether instance logs i1`"

    stable = at_site(new_record, State.RUNNING, failures=4, running_at=NOW - 10)
    after = after_crash(Crash(stable, "ended"), NOW, T).after
    assert (after.state, after.failures, after.start_at) == (State.STARTING, 1, NOW)


@pytest.mark.parametrize(
    ("observation", "text"),
    [
        (seen(Phase.EXITED), "ended"),
        (seen(Phase.EXITED, exit_status=0), "ended with exit status 0"),
        (seen(Phase.EXITED, exit_status=-9, last_line="x"), 'was killed by signal 9; its last line: "x"'),
    ],
)
def test_how_it_ended(observation: Observation, text: str) -> None:
    assert how_it_ended(observation) == text


def test_illegal_moves_raise() -> None:
    for old in State:
        for new in State:
            if new is old or new in MOVES[old]:
                check_move(old, new)
            else:
                with pytest.raises(IllegalMoveError):
                    check_move(old, new)
    assert all(not MOVES[state] for state in State if state.final)


class World:
    """A site and a store in a few lines: carries actions out, loses some of them, and checks what must always hold."""

    def __init__(self, record: Record) -> None:
        self.record = record
        self.run: Observation | None = None
        self.now = NOW
        self.starts: list[int] = []

    def change(self, **changes: Any) -> None:
        new = dataclasses.replace(self.record, **changes)
        check_move(self.record.state, new.state)
        assert new.attempt >= self.record.attempt
        self.record = new

    def look(self, lose: bool) -> None:
        actions = plan([] if self.record.state.final else [self.record], self._observed(), {"i1"}, self.now, T)
        assert len(actions) <= 1
        for action in actions:
            self.act(action, lose)

    def _observed(self) -> dict[str, Observation]:
        return {} if self.run is None else {"i1": self.run}

    def act(self, action: Action, lose: bool) -> None:
        match action:
            case Place():
                self.change(state=State.PLACING)
                if not lose:
                    self.change(state=State.STARTING, site="lab")
            case Start(record):
                self.change(started_at=self.now)
                if not lose:
                    assert self.run is None or self.run.phase is Phase.EXITED, "two runs at once"
                    self.run = seen(Phase.STARTING, record.attempt)
                    self.starts.append(record.attempt)
            case Ready(_, host, port):
                assert self.run is not None
                assert self.run.phase is Phase.RUNNING
                self.change(state=State.RUNNING, host=host, port=port, running_at=self.now)
            case Crash():
                self.change(**after_crash(action, self.now, T).columns)
            case Expire(record):
                to = State.STOPPING if record.site else State.STOPPED
                self.change(state=to, stopping_at=self.now)
            case Stop(_, force):
                if self.run is not None and not lose:
                    self.run = dataclasses.replace(self.run, phase=Phase.EXITED, exit_status=-9 if force else 0)
            case End():
                assert self.run is None or self.run.phase is Phase.EXITED
                self.change(state=State.STOPPED)
            case Remove():
                raise AssertionError("the store knows it")

    def happen(self, what: str) -> None:
        if what == "renew" and not self.record.state.final and self.record.state is not State.STOPPING:
            self.change(lease_expires_at=self.now + self.record.lease_s)
        elif what == "delete" and self.record.state in (State.STARTING, State.RUNNING):
            self.change(state=State.STOPPING, stopping_at=self.now)
        elif what == "reboot":
            self.run = None
        elif self.run is not None and self.run.phase is not Phase.EXITED:
            if what == "ready":
                self.run = dataclasses.replace(self.run, phase=Phase.RUNNING, host="h", port=1)
            elif what == "crash":
                self.run = dataclasses.replace(self.run, phase=Phase.EXITED, exit_status=1)


happenings = st.lists(
    st.tuples(
        st.sampled_from(["nothing", "renew", "ready", "crash", "reboot", "delete"]),
        st.floats(0, 8),
        st.booleans(),
    ),
    max_size=40,
)


@pytest.mark.slow
@settings(max_examples=100, deadline=None)
@given(happenings)
def test_whatever_happens_there_is_one_run_at_most_and_quiet_brings_what_is_wanted(
    story: list[tuple[str, float, bool]],
) -> None:
    world = World(
        Record(
            id="i1",
            robot="r",
            service="s",
            session_id="0",
            manifest={},
            created_at=NOW,
            updated_at=NOW,
            lease_s=15,
            lease_expires_at=NOW + 15,
        )
    )
    for what, wait, lose in story:
        world.happen(what)
        world.now += wait
        world.look(lose)
    assert world.starts == sorted(world.starts)
    # No more trouble, and a robot that renews: within the longest back-off it runs, or it has ended.
    for _ in range(60):
        world.now += 1
        world.happen("renew")
        world.look(lose=False)
        world.happen("ready")
    world.look(lose=False)
    state = world.record.state
    assert state is State.RUNNING or state.final
    alive = world.run is not None and world.run.phase is not Phase.EXITED
    assert alive is (state is State.RUNNING)
    # And one that does not renew gets its instance ended.
    for _ in range(20):
        world.now += 1
        world.look(lose=False)
    assert world.record.state.final
    assert world.run is None or world.run.phase is Phase.EXITED


def test_a_start_that_makes_progress_has_time(new_record: NewRecord) -> None:
    record = at_site(new_record, State.STARTING, started_at=NOW, reason="pulling x: 1 of 9 MB")
    record = dataclasses.replace(record, lease_expires_at=NOW + 999)
    late = NOW + T.start_timeout + 1
    pull = PullProgress(image="x", done_bytes=2_000_000, total_bytes=9_000_000)
    further = seen(Phase.STARTING, pull=pull)
    assert decide(record, further, late, T) == Progress(record, "pulling x: 2 of 9 MB", pull)
    same = seen(Phase.STARTING, pull=pull.model_copy(update={"done_bytes": 1_000_000}))
    assert decide(record, same, NOW + 1, T) is None
    assert isinstance(decide(record, same, late, T), Crash)


def test_what_is_not_well_is_started_again(new_record: NewRecord) -> None:
    record = at_site(new_record, State.RUNNING, host="127.0.0.1", port=4000)
    ill = dataclasses.replace(RUNNING, detail="its loop has hung for 12 s")
    crash = decide(record, ill, NOW, T)
    assert crash == Crash(record, "is not well: its loop has hung for 12 s")
    assert decide(record, RUNNING, NOW, T) is None


def test_a_runtime_may_know_better_how_it_ended() -> None:
    ended = seen(Phase.EXITED, exit_status=-9, detail="ran out of memory", last_line="x")
    assert how_it_ended(ended) == 'ran out of memory; its last line: "x"'


def test_robots_that_were_cut_off_with_their_site_get_time_to_renew(new_record: NewRecord) -> None:
    """A day later their leases are over, and neither they nor what they have could say a word."""
    now = NOW + 86_400
    short = at_site(new_record, State.RUNNING, lease_s=15, host="127.0.0.1", port=4000)
    assert decide(short, RUNNING, now, T, seen_since=now - 14) is None
    assert decide(short, RUNNING, now, T, seen_since=now - 15) == Expire(short)
    long = dataclasses.replace(short, lease_s=3600)
    assert decide(long, RUNNING, now, T, seen_since=now - 59) is None
    assert decide(long, RUNNING, now, T, seen_since=now - 60) == Expire(long)
