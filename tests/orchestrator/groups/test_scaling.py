from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skytether.api.groups import GroupCreate, Headroom, Stage
from skytether.api.manifest import Needs
from skytether.orchestrator.groups.scaling import (
    BACKOFF,
    BACKOFF_MAX,
    Drain,
    Drop,
    GroupView,
    MachineView,
    Make,
    Step,
    Waiting,
    backoff,
    decide,
    has_headroom,
)
from skytether.orchestrator.runtimes.base import Capacity

NOW = 1_700_000_000.0
FOUR = Capacity(4.0, 8192)


def asked(name: str = "cloud", **more: Any) -> GroupCreate:
    return GroupCreate.model_validate({"name": name, "provider": "local", "max": 4, **more})


def group(*machines: MachineView, offer: Capacity | None = FOUR, **more: Any) -> GroupView:
    known = {key: more.pop(key) for key in ("failures", "retry_at", "draining") if key in more}
    return GroupView(asked(**more), offer, machines, **known)


def ready(name: str, used: float = 0.0, idle_for: float | None = None) -> MachineView:
    """Idle for so long; or for no time, where something runs."""
    since = None if used else NOW - (idle_for or 0.0)
    free = Capacity(4.0 - used, 8192)
    return MachineView(name, Stage.READY, NOW - 1000, int(used > 0), free, 4.0, since)


def coming(name: str, stage: Stage = Stage.JOINING, since: float = NOW) -> MachineView:
    return MachineView(name, stage, since)


def waits(id_: str = "i1", cpu: float = 2.0, waited: float = 10.0, groups: tuple[str, ...] = ("cloud",)) -> Waiting:
    return Waiting(id_, Needs(cpu=cpu), NOW - waited, groups)


def made(steps: list[Step]) -> list[str]:
    return [step.group for step in steps if isinstance(step, Make)]


def given_back(steps: list[Step]) -> list[str]:
    return [step.machine for step in steps if not isinstance(step, Make)]


def test_nothing_waits_and_nothing_is_done() -> None:
    assert decide([group(), group(ready("a", used=1), name="other")], [], NOW) == []


def test_one_that_waits_is_worth_a_machine_and_the_reason_says_which() -> None:
    (step,) = decide([group()], [waits()], NOW)
    assert step == Make("cloud", "instance i1 waits for 2 cores and 128 MiB")


def test_it_must_have_waited_for_a_while() -> None:
    assert decide([group(grow_after_s=3)], [waits(waited=2.9)], NOW) == []
    assert made(decide([group(grow_after_s=3)], [waits(waited=3)], NOW)) == ["cloud"]


def test_those_that_wait_share_machines() -> None:
    """Four machines of 4 cores: two instances of 2 cores fit into one."""
    five = [waits(f"i{n}") for n in range(5)]
    assert made(decide([group(parallel=9)], five, NOW)) == ["cloud"] * 3


def test_what_is_coming_counts() -> None:
    two = [waits("i1"), waits("i2")]
    assert decide([group(coming("a"))], two, NOW) == []
    assert decide([group(coming("a", Stage.MAKING))], two, NOW) == []
    assert made(decide([group(coming("a"))], [*two, waits("i3")], NOW)) == ["cloud"]


def test_what_goes_does_not_count_as_room_nor_as_a_machine() -> None:
    leaving = [coming("a", Stage.DRAINING), coming("b", Stage.REMOVING)]
    assert made(decide([group(*leaving, max=1)], [waits()], NOW)) == ["cloud"]


def test_never_beyond_max_whoever_waits() -> None:
    crowd = [waits(f"i{n}", cpu=4) for n in range(9)]
    assert made(decide([group(ready("a", used=4), max=3, parallel=9)], crowd, NOW)) == ["cloud"] * 2
    assert decide([group(ready("a", used=4), max=1)], crowd, NOW) == []


def test_only_so_many_at_once() -> None:
    crowd = [waits(f"i{n}", cpu=4) for n in range(9)]
    assert len(decide([group(parallel=2)], crowd, NOW)) == 2
    assert len(decide([group(coming("a"), parallel=2)], crowd, NOW)) == 1
    assert decide([group(coming("a"), coming("b"), parallel=2)], crowd, NOW) == []


def test_the_best_group_grows_and_the_next_one_when_it_is_full() -> None:
    cheap, dear = group(name="cheap", max=1), group(name="dear")
    two = [waits("i1", cpu=4, groups=("cheap", "dear")), waits("i2", cpu=4, groups=("cheap", "dear"))]
    assert made(decide([dear, cheap], two, NOW)) == ["dear", "cheap"]
    assert made(decide([dear, cheap], two[:1], NOW)) == ["cheap"]


def test_a_group_that_fails_lets_the_next_one_grow() -> None:
    failing = group(name="cheap", failures=2, retry_at=NOW + 5)
    steps = decide([failing, group(name="dear")], [waits(groups=("cheap", "dear"))], NOW)
    assert made(steps) == ["dear"]


def test_a_group_that_is_busy_with_as_many_as_it_may_does_not_send_those_that_wait_to_a_dearer_one() -> None:
    busy = group(coming("a"), name="cheap", parallel=1)
    crowd = [waits(f"i{n}", cpu=4, groups=("cheap", "dear")) for n in range(3)]
    assert decide([busy, group(name="dear")], crowd, NOW) == []


def test_who_fits_no_machine_makes_none() -> None:
    assert decide([group()], [waits(groups=())], NOW) == []
    assert decide([group()], [waits(groups=("gone",))], NOW) == []
    assert decide([group(offer=None)], [waits()], NOW) == []


def test_min_is_made_and_kept() -> None:
    assert made(decide([group(min=2)], [], NOW)) == ["cloud"] * 2
    assert made(decide([group(min=2, offer=None)], [], NOW)) == ["cloud"] * 2
    idle = [ready(name, idle_for=1e5) for name in "abc"]
    assert given_back(decide([group(*idle, min=2)], [], NOW)) == ["a"]


def test_the_longest_idle_goes_first_and_none_before_its_time() -> None:
    machines = [ready("a", idle_for=700), ready("b", idle_for=900), ready("c", idle_for=599), ready("d", used=1)]
    steps = decide([group(*machines, idle_s=600, min=3)], [], NOW)
    assert steps == [Drain("cloud", "b", "it was idle for 900 s")]
    assert given_back(decide([group(*machines, idle_s=600)], [], NOW)) == ["b", "a"]


def test_none_goes_while_something_waits_that_it_may_take() -> None:
    machines = [ready("a", idle_for=700)]
    assert decide([group(*machines)], [waits(waited=0.1)], NOW) == []
    other = group(ready("b", idle_for=700), name="other")
    assert given_back(decide([group(*machines), other], [waits()], NOW)) == ["b"]


@pytest.mark.parametrize("stage", [Stage.MAKING, Stage.JOINING])
def test_what_comes_is_no_reason_to_let_the_last_idle_one_go(stage: Stage) -> None:
    """Head-room is judged by what answers when something is taken away."""
    view = group(ready("a", idle_for=1e5), coming("b", stage), headroom={"cpu": 2})
    assert decide([view], [], NOW) == []


def test_headroom_is_made_and_kept() -> None:
    largest = {"cpu": 3}
    assert decide([group(ready("a", used=1), headroom=largest)], [], NOW) == []
    (step,) = decide([group(ready("a", used=2), headroom=largest)], [], NOW)
    assert step == Make("cloud", "3 cores are kept free")
    assert made(decide([group(headroom=largest)], [], NOW)) == ["cloud"]
    two = [ready("a", idle_for=700), ready("b", used=2)]
    assert decide([group(*two, headroom=largest)], [], NOW) == []
    assert given_back(decide([group(*two, headroom={"cpu": 2})], [], NOW)) == ["a"]


def test_headroom_as_a_share_counts_what_is_made_for_it() -> None:
    """8 cores, 7 of them used: half free needs 2 more machines of 4 (9 of 16 are free), not 1 (5 of 12)."""
    view = group(ready("a", used=4), ready("b", used=3), headroom={"share": 0.5}, max=9, parallel=9)
    assert made(decide([view], [], NOW)) == ["cloud"] * 2
    assert made(decide([group(headroom={"share": 0.5})], [], NOW)) == ["cloud"]


def test_headroom_that_no_machine_has_makes_no_more_than_max() -> None:
    assert len(decide([group(headroom={"cpu": 5}, parallel=9)], [], NOW)) == 4


def test_headroom_of_cores_and_memory_is_at_one_site() -> None:
    headroom = Headroom(cpu=2, memory_mb=1000)
    assert not has_headroom(headroom, [(4.0, 0), (0.0, 4000)], 8)
    assert has_headroom(headroom, [(4.0, 0), (2.0, 1000)], 8)


def test_a_machine_that_does_not_become_a_site_goes_as_a_failure_and_another_may_come() -> None:
    view = group(coming("a", since=NOW - 600), max=1)
    steps = decide([view], [waits()], NOW)
    assert steps[0] == Drop("cloud", "a", "it did not become a site within 600 s", failed=True)
    assert decide([group(coming("a", since=NOW - 599))], [waits()], NOW) == []
    assert decide([group(coming("a", Stage.MAKING, NOW - 1e5))], [waits()], NOW) == []  # nobody knows yet whether it is


def test_after_a_failure_one_is_tried_when_its_time_has_come() -> None:
    crowd = [waits(f"i{n}", cpu=4) for n in range(4)]
    assert decide([group(failures=1, retry_at=NOW + 1, parallel=4)], crowd, NOW) == []
    assert len(decide([group(failures=1, retry_at=NOW, parallel=4)], crowd, NOW)) == 1
    assert decide([group(min=1, failures=1, retry_at=NOW + 1)], [], NOW) == []


def test_backoff_doubles_to_a_bound() -> None:
    assert [backoff(n) for n in (0, 1, 2, 3)] == [0, BACKOFF, 2 * BACKOFF, 4 * BACKOFF]
    assert backoff(10_000) == BACKOFF_MAX


def test_too_many_go_those_without_use_first() -> None:
    machines = [ready("a", used=1), ready("b"), coming("c"), ready("d", used=1)]
    steps = decide([group(*machines, max=2)], [], NOW)
    assert steps == [
        Drop("cloud", "c", "the group may have 2 machines", failed=False),
        Drain("cloud", "b", "the group may have 2 machines"),
    ]


def test_a_group_that_is_to_be_deleted_gives_all_back_and_makes_none() -> None:
    machines = [ready("a", used=1), coming("b"), coming("c", Stage.DRAINING)]
    steps = decide([group(*machines, draining=True, min=2, headroom={"cpu": 1})], [waits()], NOW)
    assert [(type(step), step.machine) for step in steps if not isinstance(step, Make)] == [(Drain, "a"), (Drop, "b")]
    assert made(steps) == []


def test_a_site_that_does_not_answer_is_no_room_but_a_machine() -> None:
    silent = MachineView("a", Stage.READY, NOW - 100, 1, None, 0.0)
    assert made(decide([group(silent)], [waits()], NOW)) == ["cloud"]
    assert decide([group(silent, max=1)], [waits()], NOW) == []


def test_a_site_that_does_not_answer_goes_when_nothing_has_run_there_for_long_and_another_comes() -> None:
    """Where something runs it stays: it may be cut off, and drive a robot all the while."""
    silent = MachineView("a", Stage.READY, NOW - 1000, 0, None, 0.0, NOW - 600)
    steps = decide([group(silent, min=1, max=1)], [], NOW)
    assert steps == [
        Drain("cloud", "a", "its site takes nothing, and nothing runs there"),
        Make("cloud", "1 are always there"),
    ]
    assert decide([group(silent, min=1, max=1)], [], NOW - 1) == []
    assert decide([group(MachineView("a", Stage.READY, NOW - 1e6, 1, None), max=1)], [], NOW) == []


stages = st.sampled_from(Stage)


@st.composite
def machines(draw: st.DrawFn, name: str) -> MachineView:
    stage, used = draw(stages), draw(st.sampled_from([0.0, 0.0, 1.0, 4.0]))
    since = NOW - draw(st.floats(0, 2000))
    if stage is not Stage.READY:
        return coming(name, stage, since)
    return ready(name, used, draw(st.floats(0, 2000)))


@st.composite
def worlds(draw: st.DrawFn) -> tuple[list[GroupView], list[Waiting]]:
    views = []
    for name in ("one", "two"):
        most = draw(st.integers(1, 5))
        found = tuple(draw(machines(f"{name}-{n}")) for n in range(draw(st.integers(0, 6))))
        more = {
            "min": draw(st.integers(0, most)),
            "max": most,
            "parallel": draw(st.integers(1, 3)),
            "headroom": draw(st.sampled_from([{}, {"cpu": 2}, {"share": 0.3}, {"cpu": 5}])),
        }
        view = group(*found, name=name, failures=draw(st.integers(0, 2)), **more)
        views.append(view)
    names = st.sampled_from([(), ("one",), ("two",), ("one", "two"), ("two", "one")])
    crowd = [
        waits(f"i{n}", draw(st.sampled_from([0.5, 2.0, 4.0])), draw(st.floats(0, 10)), draw(names))
        for n in range(draw(st.integers(0, 8)))
    ]
    return views, crowd


@settings(max_examples=150, deadline=None)
@given(worlds())
def test_whatever_there_is_limits_hold(world: tuple[list[GroupView], list[Waiting]]) -> None:
    views, crowd = world
    steps = decide(views, crowd, NOW)
    for view in views:
        name, most = view.asked.name, view.asked.max
        new = made(steps).count(name)
        gone = [step.machine for step in steps if not isinstance(step, Make) and step.group == name]
        there = {one.name: one for one in view.machines if one.stage.counts}
        stay = len(there) - len(gone)
        assert len(set(gone)) == len(gone)
        assert set(gone) <= set(there), "what goes already is not touched"
        assert stay + new <= most
        idle = [s for s in steps if isinstance(s, Drain) and s.group == name and "idle" in s.why]
        if idle:
            assert new == 0, "it grows and shrinks at once"
            assert stay >= view.asked.min
            assert all(there[step.machine].instances == 0 for step in idle)


@settings(max_examples=100, deadline=None)
@given(worlds())
def test_what_was_given_back_is_not_made_again_at_once(world: tuple[list[GroupView], list[Waiting]]) -> None:
    """Hysteresis: after a step that shrinks, the same world does not grow."""
    views, crowd = world
    steps = decide(views, crowd, NOW)
    idle = {step.machine for step in steps if isinstance(step, Drain) and "idle" in step.why}
    after = [
        GroupView(v.asked, v.offer, tuple(m for m in v.machines if m.name not in idle), v.failures, v.retry_at)
        for v in views
    ]
    shrunk = {step.group for step in steps if isinstance(step, Drain) and "idle" in step.why}
    again = made(decide(after, crowd, NOW + 1))
    late = [one for one in crowd if NOW - one.since < 3 <= NOW + 1 - one.since]
    if not late:
        assert not shrunk & set(again)


def test_time_is_an_argument() -> None:
    assert decide([group(retry_at=math.inf)], [waits()], NOW) == []
