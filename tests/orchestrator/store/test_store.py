from __future__ import annotations

import dataclasses
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from threading import Barrier
from typing import Any

import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from sqlalchemy import Engine, event

from skytether.api.pull_progress import PullProgress
from skytether.api.rest import SiteCreate, State
from skytether.api.service_report import ServiceReport
from skytether.orchestrator.domain.records import Change, IllegalMoveError, Record
from skytether.orchestrator.domain.security import TokenHash
from skytether.orchestrator.domain.transitions import progressed, running
from skytether.orchestrator.scheduling.standbys import FOREVER
from skytether.orchestrator.store.database import RobotRow, TokenRow
from skytether.orchestrator.store.engine import AddressError, make_engine, migrate
from skytether.orchestrator.store.models import metadata
from skytether.orchestrator.store.store import KeyReusedError, Store

NewRecord = Callable[..., Record]
NOW = 1_700_000_000.0


def test_the_migrations_make_the_tables_of_the_models_and_may_run_again(tmp_path: Path) -> None:
    engine = make_engine(f"sqlite:///{tmp_path}/db")
    migrate(engine)
    migrate(engine)
    with engine.connect() as connection:
        context = MigrationContext.configure(connection, opts={"compare_type": True})
        assert compare_metadata(context, metadata) == []
    engine.dispose()


def test_tokens_of_the_first_schema_are_good_still(tmp_path: Path) -> None:
    engine = make_engine(f"sqlite:///{tmp_path}/db")
    migrate(engine, "0001")
    token = "sky-" + "ab" * 32
    kept = TokenHash.of(token)
    with engine.begin() as connection:
        connection.exec_driver_sql(
            "INSERT INTO robots (name, services, token_prefix, token_sha256, created_at) VALUES (?, ?, ?, ?, ?)",
            ("walker", '["*"]', kept.prefix, kept.digest, NOW),
        )
    engine.dispose()
    store = Store(f"sqlite:///{tmp_path}/db")
    store.migrate()
    assert [row.name for row in store.robots()] == ["walker"]
    ((row, robot),) = store.holders(kept.prefix)
    assert robot is not None
    assert robot.services == ("*",)
    assert row.robot == "walker"
    assert row.hash.matches(token)
    store.close()


def test_an_instance_comes_back_as_it_was(store: Store, new_record: NewRecord) -> None:
    record = new_record(
        params={"a": [1, {"b": None}]}, measurements={"lab": {"rtt_ms": 3.5}}, refused=[{"site": "x"}], site="lab"
    )
    assert store.add(record, "operator", None, "") == record
    assert store.get("i1") == record
    assert store.get("i2") is None


def test_lists_are_by_robot_by_site_and_without_the_ended(store: Store, new_record: NewRecord) -> None:
    for record in (
        new_record("a", site="lab", created_at=NOW),
        new_record("b", robot="other", created_at=NOW + 1),
        new_record("c", site="lab", state=State.FAILED, created_at=NOW + 2),
    ):
        store.add(record, "operator", None, "")
    assert [r.id for r in store.all()] == ["c", "b", "a"]
    assert [r.id for r in store.all("other")] == ["b"]
    assert [r.id for r in store.live()] == ["a", "b"]
    assert [r.id for r in store.live_at("lab")] == ["a"]
    assert store.known(["a", "c", "nobody"]) == {"a", "c"}


def test_looking_again_reads_only_what_changed(store: Store, new_record: NewRecord) -> None:
    for name in ("a", "b", "c"):
        store.add(new_record(name, site="lab", state=State.RUNNING), "operator", None, "")
    before = store.live()
    assert [old is new for old, new in zip(before, store.live_at("lab"), strict=True)] == [True] * 3
    store.renew("b", NOW + 1, 60)
    store.change(Change(before[2], {"state": State.STOPPING}), NOW)
    now = store.live()
    assert [old is new for old, new in zip(before, now, strict=True)] == [True, False, False]
    assert now == [store.get(name) for name in ("a", "b", "c")]
    store.change(Change(now[2], {"state": State.STOPPED}), NOW)
    listed = store.all()
    assert listed == [store.get(name) for name in ("a", "b", "c")]
    assert [old is new for old, new in zip(now, listed, strict=True)] == [True, True, False]


def test_all_that_changed_is_read_by_who_saw_it_before(tmp_path: Path, store: Store, new_record: NewRecord) -> None:
    standby = store.add(new_record("warm", robot="", standby=True, state=State.RUNNING), "", None, "")
    with closing(Store(f"sqlite:///{tmp_path}/state.db")) as other:
        assert other.live() == [standby]
        claimed = store.claim(Change(standby, {"robot": "walker", "standby": False}), NOW, "", None, "")
        assert claimed is not None
        assert other.live() == [claimed]


@pytest.mark.parametrize("seen", [True, False], ids=["seen before", "new"])
def test_what_changes_while_it_is_listed_is_listed_only_if_it_fits_still(
    tmp_path: Path, store: Store, new_record: NewRecord, seen: bool
) -> None:
    """A list is read in two steps, and others change and end instances between them."""
    warm = [
        store.add(new_record(name, robot="", standby=True, state=State.RUNNING, site="lab"), "", None, "")
        for name in ("ended", "given", "left", "stays")
    ]
    with closing(Store(f"sqlite:///{tmp_path}/state.db")) as other:
        if seen:
            assert other.live_standbys() == warm
            warm = [now for one in warm if (now := store.change(Change(one, {"reason": "seen by nobody yet"}), NOW))]
        ended, given, left, _ = warm

        @event.listens_for(Engine, "after_cursor_execute", once=True)
        def change(*_: Any) -> None:
            store.change(Change(ended, {"state": State.FAILED}), NOW)
            store.claim(Change(given, {"robot": "walker", "standby": False}), NOW, "", None, "")
            store.change(Change(left, {"reason": "it has another reason"}), NOW)

        assert [one.id for one in other.live_standbys()] == ["left", "stays"]


def test_standbys_and_reports_that_matter_alone(store: Store, new_record: NewRecord) -> None:
    store.add(new_record("warm", standby=True, state=State.RUNNING), "", None, "")
    store.add(new_record("cold", standby=True, state=State.STARTING), "", None, "")
    store.add(new_record("other", standby=True, state=State.RUNNING, service="other"), "", None, "")
    assert [r.id for r in store.standbys("toy")] == ["warm"]
    for name, source in (("a", "cloud"), ("b", "stop"), ("c", None)):
        store.add(new_record(name, state=State.RUNNING), "operator", None, "")
        store.keep_robot_reports({name: (NOW, {"control_source": source})}, {("walker", "toy"): [("robot:a", {})]})
    assert store.reports() == {n: {"control_source": s} for n, s in (("a", "cloud"), ("b", "stop"), ("c", None))}
    assert store.reports(("stop", "fallback")) == {"b": {"control_source": "stop"}}


def test_a_change_needs_to_have_seen_the_last_one(store: Store, new_record: NewRecord) -> None:
    first = store.add(new_record(), "operator", None, "")
    second = store.change(Change(first, {"state": State.PLACING}), NOW + 1)
    assert second is not None
    assert second.updated_at == NOW + 1
    assert store.change(Change(first, {"state": State.STOPPED}), NOW + 2) is None
    assert store.get("i1") == second


def _change_several(store: Store, new_record: NewRecord) -> None:
    told: list[str] = []
    store.on_change = told.append
    seen = [store.add(new_record(name), "operator", None, "") for name in ("i1", "i2", "i3")]
    ended = store.change(Change(seen[1], {"state": State.STOPPED}), NOW + 1)
    to = {"state": State.STARTING, "site": "lab"}
    done = store.change_all([Change(record, to, State.PLACING) for record in seen], NOW + 2)
    assert [record and record.site for record in done] == ["lab", None, "lab"]
    assert [store.get(name) for name in ("i1", "i2", "i3")] == [done[0], ended, done[2]]
    assert [event.state for event in store.events("i3", 0)] == ["pending", "placing", "starting"]
    assert told == ["i1", "i2", "i3", "i2", "i1", "i3"]
    more = [store.add(new_record(name), "operator", None, "") for name in ("i4", "i5")]
    assert [store.get(one.id) for one in more] == more
    assert store.change_all([Change(one, to, State.PLACING) for one in more], NOW + 2) == [
        store.get("i4"),
        store.get("i5"),
    ]
    assert [event.state for event in store.events("i5", 0)] == ["pending", "placing", "starting"]
    with pytest.raises(IllegalMoveError):
        store.change_all([Change(done[0], {"reason": "x"}), Change(ended, {"state": State.RUNNING})], NOW + 3)  # type: ignore[arg-type]
    assert store.get("i1") == done[0]


def test_of_several_changes_at_once_those_are_made_that_have_seen_the_last_one(
    store: Store, new_record: NewRecord
) -> None:
    _change_several(store, new_record)


@pytest.mark.postgres
@pytest.mark.slow
def test_and_so_in_postgresql(postgres: str, new_record: NewRecord) -> None:
    with closing(Store(postgres)) as store:
        store.migrate()
        _change_several(store, new_record)


def test_a_change_of_neither_state_nor_reason_is_no_event(store: Store, new_record: NewRecord) -> None:
    told: list[str] = []
    store.on_change = told.append
    record = store.add(new_record(), "operator", None, "")
    quiet = store.change(Change(record, {"refused": [{"site": "x"}]}), NOW + 1)
    assert quiet is not None
    assert quiet.updated_at == NOW
    loud = store.change(Change(quiet, {"reason": "r" * 5000}), NOW + 2)
    assert loud is not None
    assert len(loud.reason) == 1024
    assert [e.reason[:1] for e in store.events("i1", 0)] == ["", "r"]
    assert told == ["i1", "i1"]


def test_how_far_a_pull_is_stands_beside_the_reason_and_goes_with_it(store: Store, new_record: NewRecord) -> None:
    record = store.add(new_record(state=State.STARTING, site="lab"), "operator", None, "")
    pull = PullProgress(image="x:1", done_bytes=3_000_000, total_bytes=9_000_000)
    pulling = store.change(progressed(record, NOW, str(pull), pull), NOW)
    assert pulling is not None
    assert (pulling.reason, pulling.pull) == ("pulling x:1: 3 of 9 MB", pull.model_dump())
    ready = store.change(running(pulling, NOW, "127.0.0.1", 7600), NOW)
    assert ready is not None
    assert ready.pull is None
    assert [event.pull for event in store.events("i1", 0)] == [None, pull.model_dump(), None]


def test_an_illegal_move_changes_nothing(store: Store, new_record: NewRecord) -> None:
    record = store.add(new_record(), "operator", None, "")
    with pytest.raises(IllegalMoveError, match="cannot go from pending to running"):
        store.change(Change(record, {"state": State.RUNNING}), NOW)
    assert store.get("i1") == record


def test_an_idempotency_key_gives_the_same_instance_to_its_owner_only(store: Store, new_record: NewRecord) -> None:
    first = store.add(new_record("a"), "robot:r", "key", "body")
    assert store.add(new_record("b"), "robot:r", "key", "body") == first
    assert store.get("b") is None
    with pytest.raises(KeyReusedError):
        store.add(new_record("c"), "robot:r", "key", "another body")
    assert store.get("c") is None
    assert store.add(new_record("d"), "robot:s", "key", "body").id == "d"
    assert store.made_with("robot:r", "new", "body") is None


def test_of_many_requests_with_one_key_at_once_one_makes_an_instance(store: Store, new_record: NewRecord) -> None:
    found: list[str] = []
    barrier = threading.Barrier(8)

    def ask(number: int) -> None:
        barrier.wait()
        found.append(store.add(new_record(f"i{number}"), "robot:r", "key", "body").id)

    threads = [threading.Thread(target=ask, args=(n,)) for n in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 8
    assert len(set(found)) == 1
    assert len(store.all()) == 1


def test_of_many_changes_at_once_one_is_made(store: Store, new_record: NewRecord) -> None:
    record = store.add(new_record(), "operator", None, "")
    made: list[Record | None] = []
    barrier = threading.Barrier(8)

    def change(number: int) -> None:
        barrier.wait()
        made.append(store.change(Change(record, {"reason": str(number)}), NOW))

    threads = [threading.Thread(target=change, args=(n,)) for n in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sum(one is not None for one in made) == 1


def test_a_renewal_beats_who_was_about_to_end_it(store: Store, new_record: NewRecord) -> None:
    record = store.add(new_record(site="lab", state=State.RUNNING), "operator", None, "")
    renewed = store.renew("i1", NOW + 14, None)
    assert renewed is not None
    assert renewed.record.lease_expires_at == NOW + 29
    assert store.change(Change(record, {"state": State.STOPPING}), NOW + 15) is None
    longer = store.renew("i1", NOW + 20, 60)
    assert longer is not None
    assert (longer.record.lease_s, longer.record.lease_expires_at) == (60, NOW + 80)


def test_a_renewal_that_comes_late_takes_nothing_from_a_later_one(store: Store, new_record: NewRecord) -> None:
    store.add(new_record(site="lab", state=State.RUNNING), "operator", None, "")
    store.renew("i1", NOW + 60, None)
    for late in (None, 15):  # of an orchestrator that was frozen before it asked the database
        renewed = store.renew("i1", NOW + 14, late)
        assert renewed is not None
        assert renewed.record.lease_expires_at == NOW + 75
    store.extend_leases(NOW + 20, at_least=True)
    assert store.all()[0].lease_expires_at == NOW + 75
    store.extend_leases(NOW + 70, at_least=True)
    assert store.all()[0].lease_expires_at == NOW + 85
    shorter = store.renew("i1", NOW + 61, 5)
    assert shorter is not None
    assert shorter.record.lease_expires_at == NOW + 66


def test_what_ends_is_not_renewed(store: Store, new_record: NewRecord) -> None:
    store.add(new_record("a", state=State.STOPPING), "operator", None, "")
    store.add(new_record("b", state=State.FAILED), "operator", None, "")
    assert [store.renew(i, NOW, None) for i in ("a", "b", "nobody")] == [None] * 3


def test_leases_are_whole_again_after_a_time_without_orchestrator(store: Store, new_record: NewRecord) -> None:
    store.add(new_record("short", lease_s=10, lease_expires_at=NOW + 1), "operator", None, "")
    store.add(new_record("dated", lease_s=10, lease_expires_at=NOW + 5000), "operator", None, "")
    store.add(new_record("nobody's", lease_s=10, lease_expires_at=FOREVER, standby=True), "operator", None, "")
    store.extend_leases(NOW + 1000)
    leases = {r.id: r.lease_expires_at for r in store.all()}
    assert leases == {"short": NOW + 1010, "dated": NOW + 1010, "nobody's": FOREVER}


def test_the_old_the_many_and_the_oldest_events_are_forgotten(store: Store, new_record: NewRecord) -> None:
    live = store.add(new_record("live"), "operator", "key", "")
    for age, name in ((5, "new"), (6, "third"), (7, "many"), (1000, "old")):
        store.add(new_record(name, state=State.STOPPED, updated_at=NOW - age, site="lab"), "operator", name, "")
    gone = store.prune(NOW, ended_age=100, ended_count=2, events_count=1000)
    assert sorted(gone) == [("many", "lab"), ("old", "lab")]
    assert store.made_with("operator", "old", "") is None
    assert store.events("old", 0) == []
    assert store.made_with("operator", "key", "") == live
    for number in range(10):
        live = store.change(Change(live, {"reason": str(number)}), NOW) or live
    store.prune(NOW, ended_age=100, ended_count=2, events_count=3)
    assert [e.reason for e in store.events("live", 0)] == ["7", "8", "9"]


def tell(store: Store, record: Record, numbers: range) -> Record:
    for number in numbers:
        record = store.add_service_reports(record, NOW, [ServiceReport(number, "said", str(number))]) or record
    return record


def check_that_a_talker_pushes_out_nothing(store: Store, new_record: NewRecord) -> None:
    for name in ("quiet", "talker"):
        store.add(new_record(name), "operator", None, "")
    talker = store.get("talker")
    assert talker is not None
    for start in range(1, 301, 150):
        talker = tell(store, talker, range(start, start + 150))
        store.prune(NOW, ended_age=100, ended_count=2, events_count=110)
    talked = [event.reason for event in store.events("talker", 0)]
    assert talked == ["", *(str(number) for number in range(201, 301))], "its newest, and how it began"
    assert [event.code for event in store.events("quiet", 0)] == [""]


def test_a_service_that_talks_all_day_pushes_out_nobody_elses_events(store: Store, new_record: NewRecord) -> None:
    check_that_a_talker_pushes_out_nothing(store, new_record)


@pytest.mark.postgres
@pytest.mark.slow
def test_nor_does_it_in_postgresql(postgres: str, new_record: NewRecord) -> None:
    store = Store(postgres)
    store.migrate()
    check_that_a_talker_pushes_out_nothing(store, new_record)
    store.close()


def test_an_instance_is_replaced_by_one_at_a_time(store: Store, new_record: NewRecord) -> None:
    store.add(new_record("old"), "operator", None, "")
    standby = store.add(new_record("standby", robot="", standby=True), "", None, "")
    first = store.add(new_record("first", replaces="old"), "operator", None, "")
    assert store.add(new_record("second", replaces="old"), "operator", None, "") == first
    assert store.get("second") is None
    taken = Change(standby, {"robot": "walker", "replaces": "old", "standby": False})
    assert store.claim(taken, NOW, "", None, "") is None
    assert store.change(Change(first, {"state": State.STOPPED}), NOW) is not None
    assert store.claim(taken, NOW, "", None, "") is not None, "the first one serves no more"


@pytest.mark.slow
@pytest.mark.postgres
def test_two_orchestrators_that_replace_an_instance_at_once_make_one_successor(
    postgres: str, new_record: NewRecord
) -> None:
    with closing(Store(postgres)) as one, closing(Store(postgres)) as other:
        one.migrate()
        one.add(new_record("old"), "operator", None, "")
        with ThreadPoolExecutor() as pool:
            for turn in range(20):
                begin = Barrier(2)

                def add(store: Store, name: str, begin: Barrier = begin) -> Record:
                    begin.wait(30)
                    return store.add(new_record(name, replaces="old"), "operator", None, "")

                made = [pool.submit(add, store, f"{turn} {store is one}") for store in (one, other)]
                first, second = (future.result(30) for future in made)
                assert first == second
                assert one.change(Change(first, {"state": State.STOPPED}), NOW) is not None


def test_event_ids_never_come_again(store: Store, new_record: NewRecord) -> None:
    store.add(new_record("a", state=State.STOPPED, updated_at=0), "operator", None, "")
    last = store.events("a", 0)[-1].id
    store.prune(NOW, ended_age=1, ended_count=0, events_count=0)
    store.add(new_record("b"), "operator", None, "")
    assert store.events("b", 0)[0].id > last


def test_robots_sites_and_services(store: Store) -> None:
    token = TokenRow("t", "r", "r", (), TokenHash("sky-12345678", "0" * 64), NOW, family="t")
    robot = RobotRow("r", ("a", "b"), NOW)
    assert store.add_robot(robot, token)
    assert not store.add_robot(robot, dataclasses.replace(token, id="u"))
    store.seen("r", NOW + 1)
    found = store.robot("r")
    assert found is not None
    assert (found.services, found.last_seen_at) == (("a", "b"), NOW + 1)
    assert store.holders("sky-12345678") == [(token, found)]
    other = TokenRow("o", "metrics", None, ("metrics",), TokenHash("sky-87654321", "1" * 64), NOW, NOW + 9, family="o")
    assert store.add_token(other)
    assert store.holders("sky-87654321") == [(other, None)]
    assert not store.add_token(dataclasses.replace(token, id="v", robot="nobody"))
    store.change_token("o", expires_at=NOW + 5, last_used_at=NOW + 4)
    assert store.tokens() == [token, dataclasses.replace(other, expires_at=NOW + 5, last_used_at=NOW + 4)]
    store.delete_robot("r")
    store.delete_robot("r")
    assert store.robots() == []
    assert [row.id for row in store.tokens()] == ["o"]
    store.delete_family("o")
    assert store.tokens() == []

    site = SiteCreate(name="lab", tier="cloud", runtime="process", options={"cpu": 1})
    assert store.add_site(site)
    assert not store.add_site(site)
    assert store.sites() == [site]
    store.drain_site("lab")
    assert store.draining_sites() == {"lab"}
    store.delete_site("lab")
    assert store.draining_sites() == set()
    assert store.sites() == []

    store.put_service("s", {"v": 1})
    store.put_service("s", {"v": 2})
    assert store.services() == {"s": {"v": 2}}
    store.delete_service("s")
    assert store.services() == {}


@pytest.mark.parametrize(
    "address", ["", "state.db", "mysql://me@host/name", "sqlite+nosuch", "postgresql://me@host:p/x"]
)
def test_an_address_of_no_database_says_what_to_write(address: str) -> None:
    with pytest.raises(AddressError, match="write postgresql://USER@HOST/NAME or sqlite:///PATH"):
        make_engine(address)


def test_no_part_of_a_password_is_taken_for_a_host() -> None:
    with pytest.raises(AddressError) as told:
        make_engine("postgresql://me@host/name".replace("@", ":a@secret@"))
    assert "write an @ of its password as %40" in str(told.value)
    assert "secret" not in str(told.value)


@pytest.mark.parametrize("scheme", ["postgres", "postgresql", "postgresql+psycopg"])
def test_the_schemes_of_postgresql(scheme: str) -> None:
    pytest.importorskip("psycopg")
    engine = make_engine(f"{scheme}://me@host/name")
    assert (engine.dialect.name, engine.dialect.driver, engine.url.host) == ("postgresql", "psycopg", "host")
