"""What every runtime must do for two orchestrators that both believe they lead: nothing twice, nothing lost."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import pytest

from skytether.orchestrator.runtimes.base import OvertakenError, Phase

Kit = Any


def until(what: Callable[[], Any], patience: float = 30.0) -> None:
    deadline = time.monotonic() + patience
    while not what():
        assert time.monotonic() < deadline, "it did not come to pass"
        time.sleep(0.01)


def test_who_was_overtaken_is_refused_and_sees_what_the_other_does(kit: Kit) -> None:
    late, leader = kit.open(), kit.open()
    late.lead(1)
    late.start(kit.launch("i1"))
    kit.until(late, Phase.RUNNING)
    leader.lead(2)
    for act in (
        lambda: late.start(kit.launch("i1", attempt=2)),
        lambda: late.start(kit.launch("i2")),
        lambda: late.stop("i1", force=False),
        lambda: late.stop("i1", force=True),
        lambda: late.remove("i1"),
    ):
        with pytest.raises(OvertakenError, match="another orchestrator leads by now"):
            act()
    with suppress(OvertakenError):  # most have nothing to tidy
        late.tidy()
    assert kit.until(leader, Phase.RUNNING).attempt == 1
    assert (kit.running("i1"), kit.running("i2")) == (1, 0)
    leader.start(kit.launch("i2"))
    kit.until(leader, Phase.RUNNING, "i2")
    kit.until(late, Phase.RUNNING, "i2")
    leader.stop("i1", force=True)
    kit.until(late, Phase.EXITED)
    leader.remove("i1")
    kit.until(late, None)


def test_the_first_look_of_a_leader_finds_what_the_one_before_has_begun(kit: Kit) -> None:
    late, leader = kit.open(), kit.open()
    late.lead(1)
    leader.observe()
    late.start(kit.launch())
    kit.until(late, Phase.RUNNING)
    leader.lead(2)
    assert leader.observe()["i1"].attempt == 1, "what it did not see it would begin anew"


def test_the_leader_of_the_latest_epoch_acts_whoever_it_is(kit: Kit) -> None:
    first, second = kit.open(), kit.open()
    first.lead(1)
    second.lead(2)
    second.lead(2)
    with pytest.raises(OvertakenError):
        first.lead(1)
    first.lead(3)
    first.start(kit.launch())
    kit.until(first, Phase.RUNNING)
    with pytest.raises(OvertakenError):
        second.remove("i1")
    with pytest.raises(OvertakenError):
        kit.open().lead(2)
    kit.open().remove("i1")  # by a tool, for no leader
    kit.until(first, None)


def test_what_the_last_leader_began_a_moment_before_is_not_begun_twice(kit: Kit) -> None:
    late, leader = kit.open(), kit.open()
    late.lead(1)
    late.start(kit.launch())
    leader.lead(2)
    leader.start(kit.launch())
    kit.until(leader, Phase.RUNNING)
    assert kit.running() == 1
    leader.remove("i1")
    kit.until(late, None)
    assert kit.running() == 0


def test_two_that_start_the_same_at_once_get_one(kit: Kit) -> None:
    both = kit.open(), kit.open()
    together = threading.Barrier(2)

    def start(runtime: Any) -> None:
        together.wait()
        runtime.start(kit.launch())

    threads = [threading.Thread(target=start, args=(runtime,)) for runtime in both]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for runtime in both:
        assert kit.until(runtime, Phase.RUNNING).attempt == 1
    assert kit.running() == 1


def test_a_start_that_comes_after_the_instance_was_removed_begins_nothing(kit: Kit) -> None:
    late, leader = kit.open(), kit.open()
    late.lead(1)
    leader.lead(2)
    leader.start(kit.launch())
    kit.until(leader, Phase.RUNNING)
    leader.remove("i1")
    with pytest.raises(OvertakenError):
        late.start(kit.launch())
    kit.until(leader, None)
    assert kit.running() == 0


def test_a_later_run_is_neither_ended_nor_doubled_by_an_earlier_one(kit: Kit) -> None:
    late, leader = kit.open(), kit.open()
    late.start(kit.launch(attempt=1))
    kit.until(late, Phase.RUNNING)
    leader.start(kit.launch(attempt=2))
    port = kit.until(leader, Phase.RUNNING).port
    until(lambda: late.observe()["i1"].attempt == 2)
    with pytest.raises(OvertakenError, match="attempt 2 of i1 runs"):
        late.start(kit.launch(attempt=1))
    seen = kit.until(late, Phase.RUNNING)
    assert (seen.attempt, seen.port, kit.running()) == (2, port, 1)


def test_who_leads_again_goes_by_what_is_there_and_not_by_what_it_remembers(kit: Kit) -> None:
    first, second = kit.open(), kit.open()
    first.lead(1)
    for instance in ("removed", "anew", "stays"):
        first.start(kit.launch(instance))
        kit.until(first, Phase.RUNNING, instance)
    second.lead(2)
    for instance in ("removed", "anew", "stays"):
        kit.until(second, Phase.RUNNING, instance)
    second.remove("removed")
    second.start(kit.launch("anew", attempt=2))
    kit.until(second, Phase.RUNNING, "anew")
    first.lead(3)
    until(lambda: {i: seen.attempt for i, seen in first.observe().items()} == {"anew": 2, "stays": 1})
    first.start(kit.launch("removed", attempt=2))
    kit.until(first, Phase.RUNNING, "removed")
    assert [kit.running(instance) for instance in ("removed", "anew", "stays")] == [1, 1, 1]
