"""Several orchestrators over one PostgreSQL database, and a database that goes away. Real servers, killed for real."""

from __future__ import annotations

import json
import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from queue import Queue
from typing import Any

import httpx
import pytest
from nothing_lost import assert_nothing_lost, processes, told
from orchestrator_program import PATIENCE, Program, environment, until, with_toy
from sqlalchemy.exc import OperationalError

from skytether.api.client import Client
from skytether.api.rest import InstanceCreate, Renew, Report, SiteCreate, State
from skytether.orchestrator.access.quotas import Quotas
from skytether.orchestrator.config.settings import Quotas as Settings
from skytether.orchestrator.domain.errors import QuotaError
from skytether.orchestrator.store.engine import make_engine
from skytether.orchestrator.store.store import Store

pytestmark = [pytest.mark.slow, pytest.mark.postgres]

ASK = InstanceCreate(robot="walker", service="toy", lease_s=1000)


class Replica(Program):
    """One of several orchestrators."""

    operator: Client | None = None
    """Of the one that is up."""

    def up(self) -> Client:
        self.spawn()
        until(lambda: (self.folder / "address").exists(), self)
        self.operator = Client(self.url, self.token)
        return self.operator

    @property
    def url(self) -> str:
        return (self.folder / "address").read_text().strip()

    @property
    def token(self) -> str:
        return (self.folder.parents[1] / "secrets" / "operator.token").read_text().strip()

    def clean_up(self) -> None:
        if self.operator is not None:
            self.operator.close()
        super().clean_up()


@pytest.fixture
def replicas(tmp_path: Path, postgres: str) -> Iterator[Callable[..., Replica]]:
    """Makes orchestrators over one database, with the same secrets; what they started ends with the test."""
    made: list[Replica] = []

    def make(name: str, *options: str) -> Replica:
        shared = ("--database", postgres, "--secrets-dir", str(tmp_path / "secrets"))
        (tmp_path / name).mkdir()
        program = Replica(tmp_path / name / "state", *shared, *options)
        made.append(program)
        return program

    (tmp_path / "secrets").mkdir(mode=0o700)
    yield make
    for program in made:
        program.clean_up()
    for pid in services(tmp_path):
        os.kill(pid, signal.SIGKILL)


def services(folder: Path) -> set[int]:
    """All processes that have a grant in a folder."""
    mine = b"SKYTETHER_GRANT=" + os.fsencode(folder)
    return {int(p.name) for p in Path("/proc").glob("[0-9]*") if mine in environment(p)}


def running(client: Client, instance: str) -> Any:
    found = client.get_instance(instance)
    return found if found.state is State.RUNNING else None


def test_one_leads_all_answer_and_when_the_leader_is_killed_another_adopts(
    replicas: Callable[..., Replica], manifest: Any, tmp_path: Path
) -> None:
    one, two = replicas("one"), replicas("two")
    first = with_toy(one.up(), manifest)
    second = two.up()
    site = SiteCreate(name="shared", tier="cloud", runtime="process", options={"folder": str(tmp_path / "instances")})
    first.create_site(site)
    first.delete_site("local")
    until(lambda: [s.name for s in second.sites()] == ["shared"])

    made = second.create_instance(ASK)  # by way of the one that does not lead
    until(lambda: running(first, made.id))
    host, port = running(first, made.id).session.host, running(first, made.id).session.port
    assert running(second, made.id).session == running(first, made.id).session
    second.renew_instance(made.id, Renew(report=Report(rtt_s=0.02, control_source="cloud")))
    until(lambda: "skytether_path_rtt_seconds{" in first.metrics())
    assert "skytether_path_rtt_seconds{" not in second.metrics()

    assert one.process is not None
    pids = services(tmp_path / "instances")
    assert len(pids) == 1
    one.process.send_signal(signal.SIGKILL)
    one.process.wait(PATIENCE)
    until(lambda: "this orchestrator leads" in two.log)
    until(lambda: "skytether_path_rtt_seconds{" in second.metrics())
    adopted = running(second, made.id)
    assert (adopted.session.host, adopted.session.port, adopted.restarts) == (host, port, 0)
    assert services(tmp_path / "instances") == pids
    again = second.create_instance(ASK)
    until(lambda: running(second, again.id))
    second.delete_instance(made.id)
    after = {made.id: State.STOPPED, again.id: State.RUNNING}
    assert_nothing_lost(told(second), after, processes(tmp_path))


def test_prometheus_is_told_of_all_that_are_connected(replicas: Callable[..., Replica], tmp_path: Path) -> None:
    made = []
    for name in ("one", "two"):
        (tmp_path / f"{name}.yaml").write_text(f"advertise: http://{name}:8600\n")
        made.append(replicas(name, "--config", str(tmp_path / f"{name}.yaml")))
        made[-1].up()
    one, two = made

    def told() -> set[str]:
        headers = {"Authorization": f"Bearer {one.token}"}
        answer = httpx.get(f"{one.url}/api/v1/prometheus/targets", headers=headers, trust_env=False)
        return {target for group in answer.json() for target in group["targets"]}

    until(lambda: told() == {"one:8600", "two:8600"})
    assert two.process is not None
    two.process.kill()
    until(lambda: told() == {"one:8600"})


def test_orchestrators_with_different_secrets_do_not_share_a_database(
    replicas: Callable[..., Replica], tmp_path: Path
) -> None:
    replicas("one").up()
    (tmp_path / "other").mkdir(mode=0o700)
    stranger = replicas("two", "--secrets-dir", str(tmp_path / "other"))
    status, text = stranger.fails()
    assert status == 1
    assert "another secret.key" in text


def test_the_database_is_away_for_longer_than_a_lease_and_nothing_is_lost(
    replicas: Callable[..., Replica], manifest: Any, postgres_server: Any
) -> None:
    program = replicas("one")
    client = with_toy(program.up(), manifest)
    made = client.create_instance(ASK.model_copy(update={"lease_s": 3}))
    until(lambda: running(client, made.id))
    pids = program.services()
    told_of = Queue[str | None]()
    watching = threading.Thread(target=watch, args=(program, made.id, told_of))
    watching.start()
    assert told_of.get(timeout=30)
    postgres_server.stop()
    try:
        time.sleep(4)  # longer than the lease: what cannot be renewed must not end
        answer = httpx.get(
            f"{program.url}/api/v1/instances/{made.id}", headers={"Authorization": f"Bearer {program.token}"}
        )
        assert answer.status_code == 503
        assert answer.headers["retry-after"] == "2"
        assert "database does not answer" in answer.json()["detail"]
        assert httpx.get(f"{program.url}/readyz").status_code == 503
    finally:
        postgres_server.start()
    until(lambda: httpx.get(f"{program.url}/readyz").status_code == 200, program)
    back = client.renew_instance(made.id, Renew(lease_s=1000))
    assert (back.state, back.restarts) == (State.RUNNING, 0)
    assert program.services() == pids
    assert_nothing_lost(told(client), {made.id: State.RUNNING}, processes(program.folder))
    client.delete_instance(made.id)
    watching.join(30)
    assert [line for line in iter(told_of.get_nowait, None) if line][-1] == "stopped", "the stream went on"
    assert program.log.count("the database does not answer, trying again") <= 3
    assert "Traceback" not in program.log


def watch(program: Replica, instance: str, states: Queue[str | None]) -> None:
    """One stream of events, from its begin to its end, which is None."""
    url, headers = f"{program.url}/api/v1/instances/{instance}/events", {"Authorization": f"Bearer {program.token}"}
    try:
        with httpx.stream("GET", url, headers=headers, timeout=60) as answer:
            for line in answer.iter_lines():
                if line.startswith("data:"):
                    states.put(json.loads(line.removeprefix("data:"))["state"])
    finally:
        states.put(None)


def test_a_server_that_hangs_is_given_up_and_then_one_at_a_time_waits_for_it(
    postgres: str, postgres_server: Any
) -> None:
    engine = make_engine(postgres, patience_s=0.5)
    done = threading.Event()

    def ask() -> int:
        with engine.connect() as connection:
            return int(connection.exec_driver_sql("SELECT 1").scalar_one())

    def go_on_asking() -> None:
        while not done.is_set():
            outcome(ask)

    assert ask() == 1
    other = threading.Thread(target=go_on_asking, daemon=True)
    postgres_server.signal(signal.SIGSTOP)
    try:
        other.start()
        until(lambda: "the server does not answer" in outcome(ask))
    finally:
        postgres_server.signal(signal.SIGCONT)
    until(lambda: outcome(ask) == "1")
    done.set()
    other.join(PATIENCE)
    engine.dispose()


def outcome(ask: Callable[[], int]) -> str:
    try:
        return str(ask())
    except OperationalError as error:
        return str(error)


def test_a_transaction_that_stood_still_for_too_long_is_a_connection_that_is_gone(postgres: str) -> None:
    engine = make_engine(postgres)
    with engine.connect() as connection:
        connection.exec_driver_sql("SET idle_in_transaction_session_timeout = 50")
        time.sleep(0.5)
        with pytest.raises(OperationalError, match="idle-in-transaction"):
            connection.exec_driver_sql("SELECT 1")
    with engine.begin() as connection:
        assert connection.exec_driver_sql("SELECT 1").scalar_one() == 1
    engine.dispose()


def test_a_server_that_takes_no_changes_is_asked_anew_by_another_connection(postgres: str) -> None:
    engine = make_engine(postgres)
    with engine.connect() as connection:
        first = connection.exec_driver_sql("SELECT pg_backend_pid()").scalar_one()
        connection.exec_driver_sql("SET SESSION CHARACTERISTICS AS TRANSACTION READ ONLY")
        connection.commit()
        with pytest.raises(OperationalError, match="read-only transaction"):
            connection.exec_driver_sql("CREATE TABLE never (id int)")
    with engine.begin() as connection:
        assert connection.exec_driver_sql("SELECT pg_backend_pid()").scalar_one() != first
        connection.exec_driver_sql("CREATE TEMPORARY TABLE now (id int)")
    engine.dispose()


def test_a_database_that_is_not_there_is_one_sentence(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    (tmp_path / "one").mkdir()
    program = Program(tmp_path / "one" / "state", "--database", f"postgresql://nobody@127.0.0.1:{port}/none")
    status, text = program.fails()
    assert status == 1
    assert "the database cannot be used" in text
    assert "Traceback" not in text


def test_a_database_without_an_encoding_can_be_used(postgres: str) -> None:
    plain = f"{postgres}_plain"
    engine = make_engine(postgres).execution_options(isolation_level="AUTOCOMMIT")
    with engine.connect() as connection:
        how = "TEMPLATE template0 ENCODING 'SQL_ASCII' LC_COLLATE 'C' LC_CTYPE 'C'"
        connection.exec_driver_sql(f"CREATE DATABASE {plain.rpartition('/')[2]} {how}")
        store = Store(plain)
        store.migrate()
        assert store.agree("name", "Käthe")
        assert store.agree("name", "Käthe")
        store.close()
        connection.exec_driver_sql(f"DROP DATABASE {plain.rpartition('/')[2]} WITH (FORCE)")
    engine.dispose()


def test_two_orchestrators_do_not_both_give_a_robot_its_last_place(postgres: str, new_record: Any) -> None:
    stores = [Store(postgres), Store(postgres)]
    stores[0].migrate()
    one, two = (Quotas(store, Settings(robot_instances=1)) for store in stores)
    answers: Queue[str] = Queue()

    def ask() -> None:
        try:
            with two.admitting(new_record("i2")):
                answers.put("admitted")
        except QuotaError as error:
            answers.put(str(error))

    other = threading.Thread(target=ask)
    with one.admitting(new_record("i1")):
        other.start()
        waiting = "SELECT count(*) FROM pg_locks WHERE locktype = 'advisory' AND NOT granted"
        engine = make_engine(postgres)
        with engine.connect() as connection:
            until(lambda: not answers.empty() or connection.exec_driver_sql(waiting).scalar_one())
        engine.dispose()
        stores[0].add(new_record("i1"), "robot:walker", None, "")
    other.join(PATIENCE)
    assert "would have 2 instances" in answers.get_nowait()
    for store in stores:
        store.close()


def test_two_that_migrate_at_once_do_not_collide(postgres: str) -> None:
    pids = []
    for _ in range(2):
        pid = os.fork()
        if pid == 0:
            status = 1
            try:
                Store(postgres).migrate()
                status = 0
            finally:
                os._exit(status)
        pids.append(pid)
    assert [os.waitpid(pid, 0)[1] for pid in pids] == [0, 0]


def test_a_leader_that_is_frozen_is_replaced_and_does_nothing_when_it_goes_on(
    replicas: Callable[..., Replica], manifest: Any, tmp_path: Path
) -> None:
    one, two = replicas("one"), replicas("two")
    with_toy(one.up(), manifest)
    second = two.up()
    site = SiteCreate(name="shared", tier="cloud", runtime="process", options={"folder": str(tmp_path / "instances")})
    second.create_site(site)
    second.delete_site("local")
    made = second.create_instance(ASK)
    until(lambda: running(second, made.id))
    pids = services(tmp_path / "instances")
    assert one.process is not None
    one.process.send_signal(signal.SIGSTOP)
    began = time.monotonic()
    try:
        until(lambda: "this orchestrator leads" in two.log)
        assert time.monotonic() - began < 5, "2.4 s, and what a busy machine takes"
        later = second.create_instance(ASK)
        until(lambda: running(second, later.id))
    finally:
        one.process.send_signal(signal.SIGCONT)
    until(lambda: "this orchestrator leads no more" in one.log)
    assert_nothing_lost(told(second), {made.id: State.RUNNING, later.id: State.RUNNING}, processes(tmp_path))
    assert pids < services(tmp_path / "instances")
    assert len(services(tmp_path / "instances")) == 2
    assert "this orchestrator leads:" not in one.log[one.log.index("leads no more") :]


def test_clocks_of_orchestrators_an_hour_apart_end_nothing(
    replicas: Callable[..., Replica], manifest: Any, tmp_path: Path, faketime: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The leader's is ahead, the other one's behind; leases are dated by the database's."""
    monkeypatch.setenv("LD_PRELOAD", faketime)
    monkeypatch.setenv("FAKETIME_DONT_FAKE_MONOTONIC", "1")
    up = []
    for name, offset in (("one", "+1h"), ("two", "-1h")):
        monkeypatch.setenv("FAKETIME", offset)
        up.append(replicas(name))
        up[-1].up()
    for name in ("LD_PRELOAD", "FAKETIME"):
        monkeypatch.delenv(name)
    one, two = up
    assert one.operator is not None
    assert two.operator is not None
    with_toy(one.operator, manifest)
    made = two.operator.create_instance(ASK.model_copy(update={"lease_s": 4}))
    until(lambda: running(two.operator, made.id))
    for _ in range(8):
        time.sleep(1)
        two.operator.renew_instance(made.id, Renew())
    kept = running(one.operator, made.id)
    assert abs(kept.created_at.timestamp() - time.time()) < 60
    assert "3600 s ahead of the database's" in one.log
    assert "3600 s behind the database's" in two.log
    until(lambda: one.operator and one.operator.get_instance(made.id).state is State.STOPPED)
