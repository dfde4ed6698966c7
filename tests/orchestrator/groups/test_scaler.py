"""Groups grow, shrink and mend themselves over a made-up cloud; the orchestrator is killed at every step."""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from groups_bench import GroupsBench

from skytether.api.groups import Stage
from skytether.orchestrator.domain.errors import ConflictError, ForbiddenError, InvalidError, NotFoundError
from skytether.orchestrator.domain.records import Record
from skytether.orchestrator.providers.base import Condition, Found
from skytether.orchestrator.store.store import Store


@pytest.fixture
def made(
    tmp_path: Path, store: Store, clock: Any, new_record: Callable[..., Record]
) -> Iterator[Callable[..., GroupsBench]]:
    benches = []

    def make(**group: Any) -> GroupsBench:
        bench = GroupsBench(tmp_path, store, clock, new_record)
        benches.append(bench)
        bench.group(**group)
        return bench

    yield make
    for bench in benches:
        bench.stop()


Made = Callable[..., GroupsBench]


def nothing_left(bench: GroupsBench) -> bool:
    return not (bench.cloud.there or bench.store.machines() or bench.store.sites())


def test_it_grows_for_those_that_wait_to_its_max_and_shrinks_to_its_min(made: Made) -> None:
    bench = made(max=3, min=1)
    bench.step(2)
    assert bench.stages() == [Stage.READY]
    bench.ask("a", "b", "c", "d")
    bench.step(12)
    assert bench.stages() == [Stage.READY] * 3
    assert sorted(bench.states().values()) == ["pending", "running", "running", "running"]
    bench.end("a")
    bench.step(3)
    assert bench.states() == {"b": "running", "c": "running", "d": "running"}
    assert len(bench.cloud.orders) == 3
    bench.end("b", "c", "d")
    bench.step(50)
    assert bench.stages() == [Stage.READY] * 3, "none was idle for long"
    bench.step(20)
    assert bench.stages() == [Stage.READY]
    assert len(bench.store.sites()) == len(bench.cloud.there) == 1


def test_the_site_has_what_the_group_says(made: Made) -> None:
    bench = made(min=1, tier="cloud", cost=7.5, speed=2.0, images=["a/*"])
    bench.step(2)
    (site,) = bench.store.sites()
    assert (site.tier, site.cost, site.speed, site.images) == ("cloud", 7.5, 2.0, ("a/*",))
    (order,) = bench.cloud.orders
    assert order.name == site.name
    assert order.name.startswith("cloud-")


def test_events_say_what_was_done_and_why(made: Made) -> None:
    bench = made(max=1)
    bench.ask("a")
    bench.step(3)
    bench.end("a")
    bench.step(70)
    (name,) = {order.name for order in bench.cloud.orders}
    assert bench.told() == [
        f"{name} is made: instance a waits for 4 cores and 128 MiB",
        f"{name} is a site",
        f"{name} is given back: it was idle for 60 s",
        f"{name} is destroyed",
    ]


def test_who_needs_more_than_a_machine_has_gets_none(made: Made) -> None:
    bench = made()
    bench.ask("a", cpu=5)
    bench.ask("b", tiers=["edge"])
    bench.step(5)
    assert bench.cloud.orders == []


def test_who_waits_is_told_what_the_group_does(made: Made) -> None:
    bench = made(max=1)
    bench.ask("a")

    def reason(instance: str) -> str:
        record = bench.store.get(instance)
        assert record is not None
        return record.reason

    bench.step()
    assert reason("a") == "waiting for a site: cloud: can make a machine"
    bench.step(3)
    bench.ask("b", cpu=3)
    bench.ask("c", cpu=5)
    bench.step(2)
    assert reason("b").endswith("cloud: has all the machines that it may have (1)")
    assert reason("c").endswith("cloud: needs 5 cores, the site has 4")
    record = bench.store.get("b")
    assert record is not None
    assert not bench.placer.weigh(record, {}).hopeless
    record = bench.store.get("c")
    assert record is not None
    assert bench.placer.weigh(record, {}).hopeless, "no site, and no machine, could take it"
    bench.groups.delete("cloud", drain=True)
    bench.groups.refresh()
    record = bench.store.get("b")
    assert record is not None
    assert [prospect.hopeless for prospect in bench.demand.prospects(record)] == [True]


def test_a_machine_that_turns_out_smaller_makes_no_more_for_who_does_not_fit(made: Made) -> None:
    """A system takes its part of the memory; the provider's number is of the whole machine."""
    bench = made(max=3)
    bench.offered = 9000
    bench.ask("a", memory_mb=8500)
    bench.step(20)
    assert len(bench.cloud.orders) == 1
    bench.step(80)
    assert bench.stages() == []
    bench.step(20)
    assert len(bench.cloud.orders) == 1


def test_what_its_sites_refuse_for_good_makes_no_more_of_them(made: Made) -> None:
    bench = made(max=3)
    bench.refusing = "does not offer /dev/video0"
    bench.ask("a", "b")
    bench.step(90)
    assert len(bench.cloud.orders) == 2
    bench.ask("c")
    bench.step(90)
    assert len(bench.cloud.orders) == 2
    assert bench.stages() == []


def test_the_cheapest_group_that_meets_the_needs_grows(made: Made) -> None:
    bench = made(name="dear", cost=10, speed=1)
    bench.group("cheap", cost=1, max=1)
    bench.ask("a", "b")
    bench.step(6)
    assert sorted(order.name.rpartition("-")[0] for order in bench.cloud.orders) == ["cheap", "dear"]
    assert (bench.site_of("a") or "").startswith("cheap-")


def test_instances_fill_one_machine_so_that_another_becomes_idle(made: Made) -> None:
    bench = made(min=2)
    bench.step(3)
    bench.ask("a", cpu=1, compute_ms=1)
    bench.step(2)
    bench.ask("b", "c", cpu=1, compute_ms=1)
    bench.step(2)
    assert bench.site_of("a") == bench.site_of("b") == bench.site_of("c")


def test_a_refusal_is_told_and_tried_again_later_each_time(made: Made) -> None:
    bench = made()
    bench.cloud.most = 0
    bench.ask("a")
    bench.step()
    row = bench.store.site_group("cloud")
    assert row is not None
    assert "quota of 0 machines is used up" in row.reason
    assert (row.failures, bench.store.machines()) == (1, [])
    bench.step(8)
    assert bench.store.site_group("cloud").failures == 1  # type: ignore[union-attr]
    bench.step(3)
    assert bench.store.site_group("cloud").failures == 2  # type: ignore[union-attr]
    bench.cloud.most = 5
    bench.step(25)
    row = bench.store.site_group("cloud")
    assert row is not None
    assert (row.failures, row.reason, bench.states()) == (0, "", {"a": "running"})


def test_an_answer_that_was_lost_makes_no_second_machine(made: Made) -> None:
    bench = made()
    bench.cloud.loses_answers = True
    bench.ask("a")
    bench.step()
    bench.cloud.loses_answers = False
    bench.step(5)
    assert len(bench.cloud.orders) == len(bench.cloud.there) == 1
    assert bench.states() == {"a": "running"}


def test_one_that_was_not_made_is_ordered_again_under_its_name(made: Made) -> None:
    bench = made()
    bench.step()
    bench.ask("a")

    def fall_silent(what: str) -> None:
        bench.cloud.silent = what == "make"
        if bench.cloud.silent:
            raise ConnectionError

    bench.cloud.on_call = fall_silent
    with pytest.raises(ConnectionError):  # killed as it asked
        bench.step()
    bench.cloud.on_call = lambda _: None
    bench.cloud.silent = False
    bench.restart()
    (row,) = bench.store.machines()
    bench.step(14)
    assert bench.cloud.orders == [], "it may still come"
    bench.step(3)
    assert [order.name for order in bench.cloud.orders] == [row.name]
    assert bench.states() == {"a": "running"}


def test_two_of_one_name_become_one(made: Made) -> None:
    """A leader that was overtaken ordered as well; the list was late."""
    bench = made()
    bench.cloud.lists_late = True
    bench.ask("a")
    bench.step()
    (one,) = bench.cloud.there.items()
    bench.cloud.there["vm-0"] = (one[1][0], type(one[1][1])("vm-0", one[1][1].name, one[1][1].condition))
    bench.cloud.lists_late = False
    bench.step(3)
    assert list(bench.cloud.there) == [one[0]]
    assert bench.states() == {"a": "running"}


def test_one_that_nobody_ordered_is_destroyed_and_those_of_others_are_not(made: Made) -> None:
    bench = made()
    row = bench.store.site_group("cloud")
    assert row is not None
    found = bench.cloud.there
    found["vm-8"] = (row.owner, Found("vm-8", "cloud-lost", Condition.THERE))
    found["vm-9"] = ("somebody", Found("vm-9", "cloud-theirs", Condition.THERE))
    bench.step(2)
    assert list(found) == ["vm-9"]


def test_one_that_fails_at_the_provider_is_destroyed_and_made_once_more(made: Made) -> None:
    bench = made(max=1)

    def fail(what: str) -> None:
        for name in bench.cloud.names():
            if what == "make done":
                bench.cloud.fail(name, "no valid host was found")

    bench.cloud.on_call = fail
    bench.silent = {"*"}
    bench.sites.add = refuse  # type: ignore[method-assign]
    bench.ask("a")
    bench.step(3)
    assert bench.cloud.there == {}
    row = bench.store.site_group("cloud")
    assert row is not None
    assert "no valid host was found" in row.reason
    bench.cloud.on_call = lambda _: None
    bench.restart()
    bench.step(40)
    assert bench.states() == {"a": "running"}
    assert len(bench.cloud.orders) == 2


def refuse(*_: Any, **__: Any) -> Any:
    raise ConflictError("not yet")


def test_one_that_does_not_become_a_site_in_time_is_destroyed_and_made_once_more(made: Made) -> None:
    bench = made(max=1, join_timeout_s=30)
    bench.sites.add = refuse  # type: ignore[method-assign]
    bench.ask("a")
    bench.step(33)
    assert len(bench.cloud.destroyed) == 1
    assert "did not become a site within 30 s" in bench.store.site_group("cloud").reason  # type: ignore[union-attr]
    bench.restart()
    bench.step(40)
    assert bench.states() == {"a": "running"}


def test_one_that_somebody_deleted_is_noticed_and_what_ran_there_is_placed_anew(made: Made) -> None:
    bench = made(max=2)
    bench.ask("a")
    bench.step(4)
    (lost,) = bench.cloud.names()
    bench.cloud.there.clear()
    bench.silent.add(lost)
    bench.step(25)
    assert bench.site_of("a") == lost, "it may come back"
    bench.step(15)
    assert bench.site_of("a") not in (None, lost)
    assert bench.states() == {"a": "running"}
    assert bench.site(lost) is None
    assert f"{lost} is lost: somebody has deleted it" in bench.told()


def test_one_that_fell_silent_stays_with_what_runs_there_and_goes_without(made: Made) -> None:
    bench = made(max=1)
    bench.ask("a")
    bench.step(4)
    (first,) = bench.cloud.names()
    bench.silent.add(first)
    bench.step(100)
    assert bench.states() == {"a": "running"}
    bench.silent.clear()
    bench.end("a")
    bench.step(3)
    bench.silent.add(first)
    bench.step()
    bench.ask("b")
    bench.step(70)
    assert first not in bench.cloud.names()
    assert bench.states() == {"b": "running"}


def test_one_that_is_not_listed_but_answers_is_there(made: Made) -> None:
    bench = made()
    bench.ask("a")
    bench.step(4)
    bench.cloud.lists_late = True
    bench.step(60)
    assert bench.states() == {"a": "running"}
    assert bench.stages() == [Stage.READY]


def test_a_silent_cloud_changes_nothing_and_its_group_says_why(made: Made) -> None:
    bench = made()
    bench.ask("a")
    bench.step(4)
    bench.cloud.silent = True
    bench.end("a")
    bench.step(80)
    assert bench.stages() == [Stage.READY]
    assert bench.groups.find("cloud").obstacle == "the cloud does not answer"  # type: ignore[union-attr]
    bench.cloud.silent = False
    bench.step(80)
    assert nothing_left(bench)


def test_a_site_that_somebody_drains_or_deletes_gives_its_machine_back(made: Made) -> None:
    bench = made(min=1)
    bench.step(3)
    (first,) = bench.cloud.names()
    bench.sites.drain(first)
    bench.step(6)
    (second,) = bench.cloud.names()
    assert second != first
    bench.sites.delete(second)
    bench.step(6)
    (third,) = bench.cloud.names()
    assert third != second


def test_a_lower_max_moves_what_runs_before_a_machine_goes(made: Made) -> None:
    bench = made(max=2)
    bench.ask("a", cpu=3)
    bench.ask("b", cpu=3)
    bench.step(5)
    bench.end("a")
    bench.step(2)
    (kept,) = {bench.site_of("b")}
    bench.store.change_site_group("cloud", asked=bench.groups.find("cloud").asked.model_copy(update={"max": 1}))  # type: ignore[union-attr]
    bench.step(5)
    assert bench.cloud.names() == [kept]
    assert bench.states() == {"b": "running"}


def test_a_drained_machine_with_an_instance_waits_until_that_is_handed_over(made: Made) -> None:
    bench = made(max=2)
    bench.ask("a", "b", cpu=2)
    bench.step(4)
    first = bench.site_of("a")
    bench.sites.drain(str(first))
    bench.step(6)
    successors = [record for record in bench.store.live() if record.replaces]
    assert {record.replaces for record in successors} == {"a", "b"}
    assert {record.site for record in successors} != {first}
    assert first in bench.cloud.names()
    bench.end("a", "b")  # their robots have changed over
    bench.step(6)
    assert first not in bench.cloud.names()
    assert bench.site(str(first)) is None


def test_a_group_is_deleted_with_its_machines_only_when_told_to(made: Made) -> None:
    bench = made(min=2)
    bench.step(3)
    with pytest.raises(ConflictError, match=r"has 2 machines \(cloud-.*drain it"):
        bench.groups.delete("cloud")
    assert not bench.groups.delete("cloud", drain=True)
    bench.step(5)
    assert nothing_left(bench)
    assert bench.store.site_groups() == []
    bench.groups.refresh()
    assert bench.groups.all() == []


def test_one_without_machines_is_deleted_at_once(made: Made) -> None:
    bench = made()
    assert bench.groups.delete("cloud")
    with pytest.raises(NotFoundError, match="there is no group 'cloud'"):
        bench.groups.delete("cloud")


def test_bad_groups_are_refused_in_a_sentence(made: Made) -> None:
    bench = made()
    with pytest.raises(ConflictError, match="there is a group 'cloud' already"):
        bench.group()
    with pytest.raises(ForbiddenError, match=r"operator\.token"):
        bench.groups.add(bench.groups.find("cloud").asked, by_owner=False)  # type: ignore[union-attr]
    with pytest.raises(InvalidError, match=r"options\.cpus: .*did you mean 'cpu'"):
        bench.group("other", options={"cpus": 4})
    assert [row.name for row in bench.store.site_groups()] == ["cloud"]


class Killed(BaseException):
    """Nothing catches it, as nothing catches a kill."""


@contextlib.contextmanager
def killed_at(store: Store, number: int) -> Iterator[list[int]]:
    """Before the so-manyth change of the database, which is when the one before, and what came of it, is done."""
    count = [0]
    writing = store._writing  # noqa: SLF001 a kill tells between two changes

    @contextlib.contextmanager
    def counted(**given: Any) -> Iterator[Any]:
        count[0] += 1
        if count[0] == number:
            raise Killed
        with writing(**given) as connection:
            yield connection

    store._writing = counted  # type: ignore[method-assign]  # noqa: SLF001
    try:
        yield count
    finally:
        store._writing = writing  # type: ignore[method-assign]  # noqa: SLF001


def life(bench: GroupsBench) -> None:
    """A crowd comes, is served, and goes."""
    bench.step(4)
    bench.end(*[record.id for record in bench.store.live() if record.state.value == "running"])
    bench.step(4)
    bench.step(4, 30)
    bench.step(8)


@pytest.mark.slow
def test_killed_at_any_change_it_neither_leaks_nor_doubles(made: Made) -> None:
    number, last = 1, 10_000
    while number <= last:
        bench = made(name=f"g{number}", max=2)
        bench.ask(f"a{number}", f"b{number}", cpu=3)
        with killed_at(bench.store, number) as count:
            try:
                life(bench)
                last = count[0]
            except Killed:
                pass
        bench.restart()
        life(bench)
        if not nothing_left(bench) or bench.states():  # who was served at last goes in the next one
            life(bench)
        assert nothing_left(bench), number
        orders = [order.name for order in bench.cloud.orders]
        assert len(orders) == len(set(orders)) <= 4, number
        assert bench.states() == {}, number
        bench.groups.delete(f"g{number}")
        bench.stop()
        number += 1
    assert number > 20


@pytest.mark.parametrize("call", ["make", "make done", "destroy", "destroy done"])
@pytest.mark.parametrize("which", [1, 2])
def test_killed_at_any_call_of_the_provider_it_neither_leaks_nor_doubles(made: Made, call: str, which: int) -> None:
    bench = made(max=2)
    bench.ask("a", "b", cpu=3)
    calls = []

    def kill(what: str) -> None:
        calls.append(what)
        if calls.count(call) == which and what == call:
            raise Killed

    bench.cloud.on_call = kill
    with pytest.raises(Killed):
        life(bench)
    bench.cloud.on_call = lambda _: None
    bench.restart()
    bench.step(20)
    assert len(bench.cloud.there) <= 2
    life(bench)
    life(bench)
    assert nothing_left(bench)
    assert len(bench.cloud.orders) == len({order.name for order in bench.cloud.orders}) == 2


class Deposed:
    """A lead that is lost when it is told to be."""

    leads, epoch, elections = True, 1, 0

    def rise_above(self, epoch: int) -> None: ...


def test_a_leader_that_was_overtaken_changes_nothing(made: Made, tmp_path: Path) -> None:
    bench = made()
    bench.ask("a")
    with contextlib.closing(sqlite3.connect(tmp_path / "state.db")) as database, database:
        database.execute("UPDATE leadership SET epoch = 2")
    bench.lead = Deposed()
    bench.restart()
    bench.step(3)
    assert (bench.store.machines(), bench.cloud.orders) == ([], [])
