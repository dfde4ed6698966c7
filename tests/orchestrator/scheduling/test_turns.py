"""How little of a pass is done when little is due: and that nothing waits for it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from reconcile_bench import Bench, add

from skytether.api.rest import State
from skytether.orchestrator.config.settings import Timing
from skytether.orchestrator.domain.records import Change, Record
from skytether.orchestrator.runtimes.base import SiteSilentError
from skytether.orchestrator.scheduling.site import Site
from skytether.testing.runtimes import FakeRuntime, NeverReadyRuntime, SlowRuntime, StubbornRuntime

NewRecord = Callable[..., Record]
TIMING = Timing()


class Reads:
    """What is asked of the store on behalf of a site: True for what starts or stops only."""

    def __init__(self, bench: Bench, patch: pytest.MonkeyPatch) -> None:
        self.asked: list[bool] = []
        live_at = bench.store.live_at

        def asked(site: str, *, changing: bool = False) -> list[Record]:
            self.asked.append(changing)
            return live_at(site, changing=changing)

        patch.setattr(bench.store, "live_at", asked)

    def since(self) -> list[bool]:
        asked, self.asked = self.asked, []
        return asked


@pytest.fixture
def running(bench: Any, new_record: NewRecord, monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[Bench, Reads]]:
    """A site with one instance that runs, and after a whole pass that found nothing to be done."""

    def make(kind: type[FakeRuntime] = FakeRuntime) -> tuple[Bench, Reads]:
        b: Bench = bench(kind)
        add(b, new_record(lease_s=1000, lease_expires_at=b.clock() + 1000))
        while b.record().state is not State.RUNNING:
            b.step()
        b.step()
        b.reconciler.site_turn(b.site)  # that the instance was placed is known by now
        return b, Reads(b, monkeypatch)

    return make


def turn(b: Bench, after: float = 0.0) -> float:
    """The site's turn, some seconds later."""
    b.clock.forward(after)
    return b.reconciler.site_turn(b.site)


def end(b: Bench, name: str = "i1") -> None:
    """As a request does."""
    b.store.change(Change(b.record(name), {"state": State.STOPPING, "stopping_at": b.clock()}), b.clock())
    b.site.wake()


def test_where_nothing_changes_the_store_is_asked_once_a_second(running: Any) -> None:
    b, reads = running()
    looks = b.runtime.world["i1"].looks
    for _ in range(4):
        assert turn(b, TIMING.observe) == pytest.approx(TIMING.observe)
    assert reads.since() == []
    assert b.runtime.world["i1"].looks == looks + 4, "the runtime is asked by the period"
    assert b.site.observed["i1"].cpu_s == pytest.approx(0.01 * (looks + 4)), "what it used is known"
    turn(b, TIMING.observe)
    assert reads.since() == [False]


def test_a_crash_is_seen_by_the_period_and_mended_at_once(running: Any) -> None:
    b, _ = running()
    b.runtime.crash("i1", -9)
    turn(b, TIMING.observe)
    for _ in range(3):
        turn(b)
    assert (b.record().state, b.record().restarts) == (State.RUNNING, 1)


def test_a_crash_that_a_renewal_came_before_is_dealt_with_at_once(
    running: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    b, _ = running()
    b.runtime.crash("i1", -9)
    change = b.store.change

    def renewed_meanwhile(record: Record, now: float, **changes: Any) -> Record | None:
        monkeypatch.setattr(b.store, "change", change)
        b.store.renew("i1", now, None)
        return change(record, now, **changes)

    monkeypatch.setattr(b.store, "change", renewed_meanwhile)
    turn(b, TIMING.observe)
    assert b.record().state is State.RUNNING, "it was another version"
    for _ in range(4):
        turn(b)
    assert (b.record().state, b.record().restarts) == (State.RUNNING, 1)


def test_what_comes_and_goes_is_looked_at_alone(running: Any, new_record: NewRecord) -> None:
    b, reads = running(SlowRuntime)
    add(b, new_record("i2", lease_s=1000, lease_expires_at=b.clock() + 1000))
    b.placement.turn()
    turn(b)
    turn(b)
    while b.record("i2").state is not State.RUNNING:
        assert turn(b, 0.001) <= TIMING.observe_changing
    end(b, "i2")
    while b.record("i2").state is not State.STOPPED:
        turn(b, 0.001)
    asked = reads.since()
    assert asked == [True] * len(asked)
    assert len(asked) <= 6, "looks that show nothing new do not ask"
    assert b.record().state is State.RUNNING
    turn(b)
    assert turn(b) > TIMING.observe_changing


def test_a_call_in_the_moment_when_calls_are_taken_is_not_lost(running: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    b, reads = running()

    class Called:
        """Becomes true right after it was read as false."""

        value = False

        def __get__(self, *_: object) -> bool:
            was, self.value = self.value, True
            return was

        def __set__(self, _: object, value: bool) -> None:
            self.value = value

    monkeypatch.setattr(Site, "called", Called(), raising=False)
    turn(b)
    turn(b)
    assert reads.since() == [True]


def test_what_does_not_end_is_ended_by_force_in_time(running: Any) -> None:
    b, _ = running(StubbornRuntime)
    end(b)
    turn(b)
    waited = 0.0
    while b.record().state is not State.STOPPED:
        turn(b, TIMING.observe_changing)
        waited += TIMING.observe_changing
        assert waited < TIMING.stop_grace + 2 * TIMING.observe
    assert waited > TIMING.stop_grace


def test_what_does_not_get_ready_is_ended_in_time(bench: Any, new_record: NewRecord) -> None:
    b = bench(NeverReadyRuntime)
    add(b, new_record(lease_s=1000, lease_expires_at=b.clock() + 1000))
    b.step()
    waited = 0.0
    while b.record().restarts == 0:
        turn(b, TIMING.observe)
        waited += TIMING.observe
        assert waited < TIMING.start_timeout + 3 * TIMING.observe


def test_a_lease_that_ran_out_and_a_site_that_is_silent_are_seen_within_a_second(running: Any) -> None:
    b, _ = running()
    b.clock.forward(999.5)
    b.step()
    turn(b, 0.9)
    turn(b, 0.2)
    assert b.record().state is State.STOPPING
    b.runtime.silent = True
    assert turn(b, 1.0) == TIMING.place
    assert "does not answer" in b.site.unreachable
    b.runtime.silent = False
    turn(b, TIMING.place)
    turn(b)
    assert (b.site.unreachable, b.record().state) == ("", State.STOPPED)


def test_a_woken_placer_places_what_waits_and_leaves_the_rest_to_its_period(
    running: Any, new_record: NewRecord, monkeypatch: pytest.MonkeyPatch
) -> None:
    b, _ = running()
    watched: list[int] = []
    watch = b.successors.watch
    monkeypatch.setattr(b.successors, "watch", lambda live: (watched.append(len(live)), watch(live)))
    add(b, new_record("i2"))
    assert 0 < b.placement.turn() <= TIMING.place
    assert b.record("i2").state is State.STARTING
    b.placement.turn()
    assert watched == []
    b.clock.forward(TIMING.place)
    b.placement.turn()
    assert watched == [2]


def test_a_site_that_answers_nothing_rests_though_others_call(
    running: Any, new_record: NewRecord, monkeypatch: pytest.MonkeyPatch
) -> None:
    b, _ = running()
    for number in range(12):
        add(b, new_record(f"n{number}", lease_s=1000, lease_expires_at=b.clock() + 1000))
    start, asked = b.runtime.start, []

    def unwell(launch: Any) -> None:
        asked.append(launch.instance)
        raise SiteSilentError("the API server is busy or unwell")

    monkeypatch.setattr(b.runtime, "start", unwell)
    b.placement.turn()
    for _ in range(20):
        turn(b, 0.01)
        b.site.wake()
    assert len(asked) == 5
    monkeypatch.setattr(b.runtime, "start", start)
    turn(b, TIMING.place)
    turn(b)
    assert {b.record(f"n{number}").state for number in range(12)} == {State.RUNNING}
