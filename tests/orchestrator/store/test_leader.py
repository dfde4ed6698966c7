"""Who leads, for how long, and that whoever led before changes nothing more."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from orchestrator_program import until
from reconcile_bench import Bench, add
from sqlalchemy import text

from skytether.api.rest import State
from skytether.orchestrator.domain.clock_jump import SharedClock
from skytether.orchestrator.domain.records import Change, Record
from skytether.orchestrator.store.engine import make_engine, migrate
from skytether.orchestrator.store.leader import LEASE, Leadership, LeadLostError, Lock, fenced
from skytether.orchestrator.store.postgres import Connection
from skytether.orchestrator.store.store import Store

NewRecord = Callable[..., Record]


class Held:
    """A lock that a test gives and takes."""

    def __init__(self) -> None:
        self.epoch = 0

    def hold(self, above: int = 0) -> int:
        return self.epoch

    def release(self) -> None:
        self.epoch = 0


class Led:
    """A leadership with made-up time."""

    def __init__(self) -> None:
        self.now = 100.0
        self.lock = Held()
        self.leadership = Leadership(self.lock, lambda: self.now)


def test_whoever_has_the_lead_leads_for_less_than_it_lasts_and_begins_anew_when_it_was_late() -> None:
    one = Led()
    one.leadership.step()
    assert (one.leadership.leads, one.leadership.epoch) == (False, 0)
    one.lock.epoch = 7
    delay = one.leadership.step()
    assert (one.leadership.leads, one.leadership.epoch, one.leadership.elections) == (True, 7, 1)
    one.now += delay
    one.leadership.step()
    assert one.leadership.elections == 1
    one.now += LEASE - delay
    assert (one.leadership.leads, one.leadership.epoch) == (False, 0), "before another one can lead"
    one.leadership.step()
    assert (one.leadership.epoch, one.leadership.elections) == (7, 2), "nobody else took it; leases count anew"
    one.lock.epoch = 0
    one.leadership.step()
    assert not one.leadership.leads


def test_leases_count_anew_before_the_next_one_who_leads_ends_anything_however_long_that_takes(
    bench: Any, new_record: NewRecord, monkeypatch: pytest.MonkeyPatch
) -> None:
    b: Bench = bench()
    add(b, new_record())
    b.step(2)
    b.clock.forward(1000)  # nobody led, and nobody could renew
    one, lock = Led(), b.store.lock()
    one.leadership = Leadership(one.lock, lambda: one.now)
    one.lock.epoch = lock.hold()
    extend = b.store.extend_leases

    def slow(now: float) -> None:
        one.now += LEASE / 2
        one.leadership.step()  # by its own thread
        one.now += LEASE / 2
        one.leadership.step()
        extend(now)

    monkeypatch.setattr(b.store, "extend_leases", slow)
    b.led_by(one.leadership)
    one.leadership.step()
    assert one.leadership.leads
    b.step(2)
    assert (b.record().state, b.record().lease_expires_at) == (State.RUNNING, b.clock() + b.record().lease_s)
    b.clock.forward(1000)
    b.step(2)
    assert b.record().state is not State.RUNNING, "once only"
    lock.release()


def test_a_renewal_that_took_long_counts_from_when_it_was_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    one = Led()

    def slow(_: int) -> int:
        one.now += LEASE
        return 7

    monkeypatch.setattr(one.lock, "hold", slow)
    one.leadership.step()
    assert not one.leadership.leads


@pytest.fixture
def two(tmp_path: Path, store: Store) -> Iterator[tuple[Store, Store]]:
    other = Store(f"sqlite:///{tmp_path}/state.db")
    yield store, other
    other.close()


def in_turn(one: Lock, two: Lock) -> tuple[int, int]:
    """They lead one after the other; their epochs."""
    first = one.hold()
    assert first > 1_700_000_000, "a time, so that a restored database does not go back to epochs that were"
    assert (two.hold(), one.hold()) == (0, first)
    one.release()
    second = two.hold()
    assert second > first
    assert one.hold() == 0
    return first, second


def test_each_leader_has_a_later_epoch_and_changes_nothing_once_there_is_another(
    two: tuple[Store, Store], new_record: NewRecord
) -> None:
    one, other = two
    record = one.add(new_record(), "walker", None, "")
    locks = one.lock(), other.lock()
    first, second = in_turn(*locks)
    with fenced(first):
        for act in (
            lambda: one.change(Change(record, {"state": State.PLACING}), 1.0),
            lambda: one.extend_leases(1.0),
            lambda: one.prune(1e12, 0, 0, 0),
            lambda: one.count(record, []),
        ):
            with pytest.raises(LeadLostError, match=f"epoch {first}"):
                act()
    assert other.get(record.id) == record
    with fenced(second):
        assert other.change(Change(record, {"state": State.PLACING}), 1.0) is not None
    assert one.renew(record.id, 1.0, None) is not None, "what anybody may do is not the leader's"
    locks[1].release()


def test_a_pass_that_began_before_its_orchestrator_led_does_nothing(
    bench: Any, new_record: NewRecord, monkeypatch: pytest.MonkeyPatch
) -> None:
    b: Bench = bench()
    add(b, new_record())
    one = Led()
    b.led_by(one.leadership)
    led: list[int] = []
    monkeypatch.setattr(b.runtime, "lead", led.append)

    def elected_meanwhile() -> None:
        one.lock.epoch = lock.hold()
        one.leadership.step()

    lock = b.store.lock()
    b.sites.refresh = elected_meanwhile  # type: ignore[method-assign]
    b.placement.step()
    assert (one.leadership.leads, b.record().state) == (True, State.PENDING)
    b.step(3)  # in the first one leases count anew
    lock.release()
    assert (b.record().state, led) == (State.RUNNING, [one.leadership.epoch])


def test_a_leader_that_was_overtaken_in_the_middle_of_a_pass_leaves_it(
    bench: Any, new_record: NewRecord, two: tuple[Store, Store], caplog: pytest.LogCaptureFixture
) -> None:
    b: Bench = bench()
    add(b, new_record())
    one = Led()
    b.led_by(one.leadership)
    mine, other = (store.lock() for store in two)
    one.lock.epoch = mine.hold()
    one.leadership.step()
    mine.release()
    assert other.hold() > one.leadership.epoch
    b.step()
    assert b.record().state is State.PENDING
    assert "another orchestrator leads" in caplog.text
    other.release()


def test_a_site_that_has_heard_of_an_epoch_that_is_to_come_is_led_in_a_later_one(
    bench: Any, new_record: NewRecord, caplog: pytest.LogCaptureFixture
) -> None:
    b: Bench = bench()
    add(b, new_record())
    lock = b.store.lock()
    first = lock.hold()
    b.clock.forward(first + 100 - b.clock())
    leadership = Leadership(lock, b.clock.steady)
    b.led_by(leadership)

    def led_after_a_site_heard_of(epoch: int) -> int:
        b.runtime.world.epoch = epoch
        for _ in range(2):
            leadership.step()
            b.step(3)
        return leadership.epoch

    assert led_after_a_site_heard_of(first + 50) == first, "it may be another leader's"
    assert b.record().state is State.PENDING
    later = led_after_a_site_heard_of(first + 5000)
    assert later > first + 5000
    assert b.record().state is State.RUNNING
    assert f"heard of epoch {first + 5000}" in caplog.text
    b.site.led = 0
    assert led_after_a_site_heard_of(1 << 62) == later, "there is no such one"
    lock.release()


@pytest.mark.slow
@pytest.mark.postgres
def test_who_leads_asks_a_slow_database_no_more_than_it_must(postgres: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with closing(Store(postgres)) as store:
        store.migrate()
        lock = store.lock()

        def look() -> None:
            assert (lock.hold() > 0, store.outdated(), store.now() > 0) == (True, False, True)

        look()
        asked: list[tuple[str, float | None]] = []
        wait = Connection.wait

        def counted(connection: Connection, asking: Any, *rest: Any) -> Any:
            if "execute" in asking.__name__:
                kind = "autocommit" if connection.autocommit else "a transaction around it"
                asked.append((kind, connection.patience_s))
            return wait(connection, asking, *rest)

        monkeypatch.setattr(Connection, "wait", counted)
        look()
        assert asked == [("autocommit", 2 * LEASE)] * 3, "a round trip for each, and no long wait for its answer"
        lock.release()


@pytest.mark.slow
@pytest.mark.postgres
@pytest.mark.parametrize("used", [True, False])
def test_nobody_leads_by_the_row_before_orchestrators_of_the_schema_before_have_seen_it(
    postgres: str, used: bool
) -> None:
    engine = make_engine(postgres)
    migrate(engine, "0011")
    if used:
        with engine.begin() as connection:
            connection.execute(text("INSERT INTO sites (name, tier, runtime, options) VALUES ('a', 'edge', 'b', '{}')"))
    engine.dispose()
    with closing(Store(postgres)) as store:
        store.migrate()
        lock = store.lock()
        assert (lock.hold() == 0) is used
        until(lambda: lock.hold() > 0)
        lock.release()


@pytest.mark.slow
@pytest.mark.postgres
def test_postgresql_gives_the_lead_to_one_and_to_the_next_when_it_is_not_renewed(postgres: str) -> None:
    stores = [Store(postgres) for _ in range(2)]
    stores[0].migrate()
    one, two = (store.lock() for store in stores)
    first, second = in_turn(one, two)
    database = make_engine(postgres)
    with database.begin() as connection:  # the connection of the one that leads is ended, as firewalls do
        ours = "application_name = 'skytether' AND pid <> pg_backend_pid()"
        connection.execute(text(f"SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE {ours}"))
    assert (one.hold(), two.hold()) == (0, second)
    began = time.monotonic()
    until(lambda: one.hold() > second)
    assert LEASE - 0.5 <= time.monotonic() - began <= LEASE + 1
    with database.begin() as connection:  # the clock of the database's server is set back
        connection.execute(text("UPDATE leadership SET until = until + 3600"))
    third = two.hold()
    assert third > second
    assert two.hold() == third
    with database.begin() as connection:  # restored from a copy of when the same one led before
        connection.execute(text(f"UPDATE leadership SET epoch = {first}"))
    assert two.hold() > third, "no epoch that was"
    later = two.hold(third + 5000)
    assert later > third + 5000
    assert (two.hold(third + 5000), two.hold(), one.hold(later)) == (later, later, 0)
    database.dispose()
    for lock, store in zip((one, two), stores, strict=True):
        lock.release()
        store.close()


def test_the_clock_of_a_database_is_carried_on_by_one_that_nobody_sets(caplog: pytest.LogCaptureFixture) -> None:
    steady, said, own = [50.0], [1000.0], [4600.0]
    clock = SharedClock(lambda: said[0], lambda: steady[0], lambda: own[0])
    assert clock() == 4600.0
    clock.sync()
    assert clock() == 1000.0
    assert "this machine's clock is 3600 s ahead of the database's" in caplog.text
    caplog.clear()
    steady[0] += 7
    own[0] -= 9000
    assert clock() == 1007.0, "nobody sets it"
    said[0] += 7
    clock.sync()
    assert "behind" in caplog.text


def test_an_answer_that_took_long_moves_the_clock_no_further_than_it_must() -> None:
    steady, said = [0.0], [1000.0]
    took = [0.0]

    def asked() -> float:
        steady[0] += took[0]
        return said[0]

    clock = SharedClock(asked, lambda: steady[0], lambda: 1000.0)
    clock.sync()
    took[0], said[0] = 4.0, 1001.0  # it was asked at 1000 and answered by 1004
    clock.sync()
    assert clock() == 1004.0
    took[0], said[0] = 0.0, 1004.5
    clock.sync()
    assert clock() == 1004.5


def test_a_site_that_hears_of_ever_later_epochs_begins_no_new_one_each_time(
    bench: Any, new_record: NewRecord, caplog: pytest.LogCaptureFixture
) -> None:
    """It may be a machine that lies: with each epoch all leases count anew, and all sites are looked at anew."""
    b: Bench = bench()
    lock = b.store.lock()
    leadership = Leadership(lock, b.clock.steady)
    epochs = set()
    for number in range(1, 100):
        leadership.step()
        epochs.add(leadership.epoch)
        leadership.rise_above(leadership.epoch + number)
        b.clock.forward(1.0)
    assert len(epochs) < 10
    b.clock.forward(3600.0)
    leadership.step()
    leadership.rise_above(leadership.epoch + 1000)
    leadership.step()
    assert leadership.epoch not in epochs, "one that is right is heard, in time"
    leadership.end()
