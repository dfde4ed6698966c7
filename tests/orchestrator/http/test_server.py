"""The orchestrator as a program: real processes, killed for real."""

from __future__ import annotations

import json
import os
import signal
import socket
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
import yaml
from nothing_lost import processes
from orchestrator_program import PATIENCE, Program, alive, until, with_toy

from skytether.api.rest import Instance, InstanceCreate, State
from skytether.orchestrator.domain.errors import OutdatedError

pytestmark = pytest.mark.slow

NO_ADDRESS = "the database address cannot be used: write postgresql://USER@HOST/NAME or sqlite:///PATH"
ASK = InstanceCreate(robot="walker", service="toy", lease_s=1000)


_ENDLESS = 64 << 20
"""Bytes: many times what the kernel keeps on the way."""


def address_of(program: Program) -> tuple[str, int]:
    url = urlsplit((program.folder / "address").read_text().strip())
    return url.hostname or "", url.port or 0


@pytest.fixture
def programs(tmp_path: Path) -> Iterator[Callable[..., Program]]:
    made: list[Program] = []

    def make(*options: str, name: str = "one") -> Program:
        (tmp_path / name).mkdir(exist_ok=True)
        made.append(Program(tmp_path / name / "state", *options))
        return made[-1]

    yield make
    for program in made:
        program.clean_up()


def test_first_start_and_orderly_end(programs: Any) -> None:
    program = programs()
    with program.start() as client:
        assert [site.name for site in client.sites()] == ["local"]
        assert {"virtual-trail", "recorder"} <= {m.metadata.name for m in client.services()}
    folder = program.folder
    assert folder.stat().st_mode & 0o777 == 0o700
    for secret in ("operator.token", "secret.key"):
        assert (folder / secret).stat().st_mode & 0o777 == 0o600
    assert program.end() == 0
    assert not (folder / "address").exists()
    assert (folder / "operator.token").read_text().strip() not in program.log
    assert "Traceback" not in program.log


@pytest.mark.parametrize(
    "endless",
    [
        b"GET /" + b"a" * 65_536,
        b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nA: " + b"a" * 65_536,
        b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n" + b"a: b\r\n" * 10_000,
        b"POST /healthz HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n" + b"a: b\r\n" * 10_000,
    ],
    ids=["line", "header", "headers", "trailers"],
)
def test_a_request_whose_head_does_not_end_is_cut_off(programs: Any, endless: bytes) -> None:
    program = programs()
    with program.start() as client, socket.create_connection(address_of(program)) as stranger:
        stranger.settimeout(PATIENCE)
        sent = 0
        try:
            while sent < _ENDLESS:
                stranger.sendall(endless if not sent else endless[-60_000:])
                sent += len(endless)
        except OSError:
            pass
        assert sent < _ENDLESS, "it was let go on"
        assert client.sites()


def test_a_killed_service_is_seen_within_a_second_and_runs_again_at_the_same_port(programs: Any, manifest: Any) -> None:
    program = programs()
    with with_toy(program.start(), manifest) as client:
        made = client.wait_running(client.create_instance(ASK).id)
        pid = program.pid_of(made.id)
        seen: list[float] = []
        watching = threading.Event()

        def watch() -> None:
            for event in client.watch(made.id, timeout=PATIENCE):
                watching.set()
                if event.state is State.STARTING and event.reason:
                    seen.append(time.monotonic())
                    return

        thread = threading.Thread(target=watch)
        thread.start()
        assert watching.wait(PATIENCE)
        killed = time.monotonic()
        os.kill(pid, signal.SIGKILL)
        thread.join()
        assert seen[0] - killed < 1.0
        until(lambda: client.get_instance(made.id).state is State.RUNNING, program)
        again = client.get_instance(made.id)
        assert (again.restarts, again.session) == (1, made.session)
        assert program.pid_of(made.id) != pid


def test_a_killed_orchestrator_comes_back_adopts_what_runs_and_loses_nothing(programs: Any, manifest: Any) -> None:
    program = programs()
    with with_toy(program.start(), manifest) as client:
        made = [client.wait_running(client.create_instance(ASK).id) for _ in range(3)]
        pids = [program.pid_of(i.id) for i in made]
        events = list(client.watch(made[0].id, timeout=0.1))
        short = client.create_instance(ASK.model_copy(update={"lease_s": 2.0}), idempotency_key="short")
    program.end(signal.SIGKILL)
    assert all(alive(pid) for pid in pids)
    time.sleep(2.0)  # the short lease ends while nobody can renew it
    with program.start() as client:
        assert not client.get_instance(short.id).state.final
        for before, pid in zip(made, pids, strict=True):
            after = client.get_instance(before.id)
            assert after.model_dump(exclude={"lease_expires_at"}) == before.model_dump(exclude={"lease_expires_at"})
            assert program.pid_of(before.id) == pid
            assert alive(pid)
        assert list(client.watch(made[0].id, timeout=0.1)) == events
        assert client.get_service("toy").metadata.name == "toy"
        client.delete_instance(made[0].id)
        assert list(client.watch(made[0].id, timeout=PATIENCE))[-1].state is State.STOPPED
        assert not alive(pids[0])


def test_what_died_while_the_orchestrator_was_dead_runs_again(programs: Any, manifest: Any) -> None:
    program = programs()
    with with_toy(program.start(), manifest) as client:
        made = client.wait_running(client.create_instance(ASK).id)
    program.end(signal.SIGKILL)
    os.kill(program.pid_of(made.id), signal.SIGKILL)
    with program.start() as client:
        until(lambda: client.get_instance(made.id).restarts == 1, program)
        assert client.wait_running(made.id).session == made.session


def test_killed_in_the_middle_of_starting_it_leaves_no_doubles_and_no_orphans(programs: Any, manifest: Any) -> None:
    program = programs()
    ids: set[str] = set()
    for delay in (0.0, 0.05):
        with with_toy(program.start(), manifest) as client:
            ids |= {client.create_instance(ASK).id for _ in range(2)}
            time.sleep(delay)
            program.end(signal.SIGKILL)
    with program.start() as client:
        until(lambda: all(client.get_instance(i).state is State.RUNNING for i in ids), program)
        # By what runs, not by what was noted: it may have been killed before it noted a process.
        assert {i: len(runs) for i, runs in processes(program.folder)().items()} == dict.fromkeys(ids, 1)
        assert len(program.services()) == len(ids)


@pytest.mark.parametrize("ends", [False, True])
def test_at_shutdown_instances_run_on_unless_told_otherwise(programs: Any, manifest: Any, ends: bool) -> None:
    program = programs(*(["--stop-instances"] if ends else []))
    with with_toy(program.start(), manifest) as client:
        made = client.wait_running(client.create_instance(ASK).id)
        pid = program.pid_of(made.id)
    assert program.end() == 0
    assert alive(pid) is not ends
    with program.start() as client:
        after = client.get_instance(made.id)
        expected = (State.STOPPED, "the orchestrator was stopped") if ends else (State.RUNNING, "")
        assert (after.state, after.reason) == expected


def test_watchers_do_not_hold_up_the_end(programs: Any, manifest: Any) -> None:
    program = programs("--stop-instances")
    with with_toy(program.start(), manifest) as client:
        made = client.wait_running(client.create_instance(ASK).id)
        states: list[State] = []
        watching = threading.Event()

        def watch() -> None:
            for event in client.watch(made.id, timeout=4):
                states.append(event.state)
                watching.set()

        thread = threading.Thread(target=watch)
        thread.start()
        assert watching.wait(PATIENCE)
        began = time.monotonic()
        assert program.end() == 0
        assert time.monotonic() - began < 3
        thread.join()
        assert State.RUNNING in states


def test_at_shutdown_what_was_asked_is_answered_and_nobody_else_is_let_in(programs: Any, manifest: Any) -> None:
    program = programs()
    with program.start() as client:
        host, _, port = (program.folder / "address").read_text().strip().removeprefix("http://").rpartition(":")
        token = (program.folder / "operator.token").read_text().strip()
        body = json.dumps(manifest("late")).encode()
        head = (
            f"PUT /api/v1/catalog/late HTTP/1.1\r\nHost: {host}\r\nAuthorization: Bearer {token}\r\n"
            f"Content-Type: application/json\r\nContent-Length: {len(body)}\r\n\r\n"
        )
        assert program.process is not None
        with socket.create_connection((host, int(port))) as slow:
            slow.sendall(head.encode() + body[:10])
            client.sites()  # so it has seen the beginning of the other one
            program.process.send_signal(signal.SIGTERM)
            until(lambda: refused(host, int(port)))
            assert program.process.poll() is None
            slow.sendall(body[10:])
            assert slow.recv(65536).startswith(b"HTTP/1.1 201 ")
        assert program.process.wait(PATIENCE) == 0
    with program.start() as client:
        assert client.get_service("late").metadata.name == "late"


def refused(host: str, port: int) -> bool:
    try:
        socket.create_connection((host, port)).close()
    except ConnectionRefusedError:
        return True
    return False


def test_a_service_that_ends_at_once_is_failed_with_its_last_line(programs: Any, manifest: Any) -> None:
    program = programs()
    with with_toy(program.start(), manifest) as client:
        ask = ASK.model_copy(update={"params": {"exit_status": 2, "say": "mass: must be above 0"}})
        made = client.create_instance(ask)
        last: Instance | Any = list(client.watch(made.id, timeout=PATIENCE))[-1]
        assert last.state is State.FAILED
        assert last.reason == (
            'the service ended with exit status 2; its last line: "mass: must be above 0"; '
            "correct what it names and ask again"
        )
        assert client.logs(made.id) == "mass: must be above 0\n"


def test_a_taken_port_is_one_sentence(programs: Any) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        status, line = programs("--port", str(port)).fails()
    assert status == 1
    assert line == (
        f"error: cannot listen on 127.0.0.1 port {port}: Address already in use; give another with --host or --port"
    )


def test_an_address_that_is_not_here_is_one_sentence(programs: Any) -> None:
    status, line = programs("--host", "192.0.2.1").fails()
    assert status == 1
    assert "cannot listen on 192.0.2.1 port 0: Cannot assign requested address" in line


def test_a_second_orchestrator_over_the_same_folder_is_kept_out(programs: Any) -> None:
    first = programs()
    first.start().close()
    pid = first.process.pid
    done = subprocess.run(
        [sys.executable, "-m", "skytether.cli", "orchestrator", "run", "--state-dir", str(first.folder), "--port", "0"],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )
    assert done.returncode == 1
    assert done.stderr == (
        f"error: another orchestrator (pid {pid}) uses {first.folder}: "
        "stop it, or give another folder with --state-dir\n"
    )
    assert (first.folder / "address").exists()


def test_a_catalog_with_a_typo_is_one_sentence(programs: Any, manifest: Any, tmp_path: Path) -> None:
    (tmp_path / "cat").mkdir()
    typo = manifest(topics=[{"name": "a", "type": "b", "direction": "in", "prority": 3}])
    (tmp_path / "cat/mine.yaml").write_text(yaml.safe_dump(typo))
    status, line = programs("--catalog", str(tmp_path / "cat")).fails()
    assert status == 2
    assert line == f"error: {tmp_path}/cat/mine.yaml: spec.topics.0.prority: unknown key, did you mean 'priority'?"


def test_a_folder_of_manifests_is_served(programs: Any, manifest: Any, tmp_path: Path) -> None:
    (tmp_path / "cat").mkdir()
    (tmp_path / "cat/mine.yaml").write_text(yaml.safe_dump(manifest("mine")))
    with programs("--catalog", str(tmp_path / "cat")).start() as client:
        assert client.get_service("mine").metadata.name == "mine"


def test_a_state_folder_that_is_a_file_and_secrets_for_all_and_a_broken_database(programs: Any) -> None:
    blocked = programs(name="file")
    blocked.folder.write_text("")
    status, line = blocked.fails()
    assert (status, line) == (1, f"error: cannot make {blocked.folder}: File exists; give another --state-dir")

    open_to_all = programs(name="open")
    open_to_all.folder.mkdir(mode=0o700)
    (open_to_all.folder / "secret.key").write_bytes(b"x" * 32)
    (open_to_all.folder / "secret.key").chmod(0o644)
    key = open_to_all.folder / "secret.key"
    assert open_to_all.fails() == (1, f"error: {key} can be read by others: chmod 600 {key}")

    broken = programs(name="broken")
    broken.folder.mkdir(mode=0o700)
    (broken.folder / "state.db").write_bytes(b"no database" * 100)
    (broken.folder / "state.db").chmod(0o600)
    advice = "restore a backup (`skytether orchestrator restore`), or give another --state-dir"
    assert broken.fails() == (1, f"error: {broken.folder / 'state.db'} is no database: {advice}")


def test_an_older_orchestrator_over_a_newer_schema_is_one_sentence(programs: Any) -> None:
    older = programs()
    older.folder.mkdir(mode=0o700)
    with closing(sqlite3.connect(older.folder / "state.db")) as database:
        database.executescript(
            "CREATE TABLE alembic_version (version_num VARCHAR(32)); INSERT INTO alembic_version VALUES ('9999')"
        )
    (older.folder / "state.db").chmod(0o600)
    assert older.fails() == (1, f"error: {OutdatedError()}")


def test_a_database_address_that_is_none_is_one_sentence(programs: Any) -> None:
    status, line = programs("--database", "nosuch://x").fails()
    assert status == 2
    assert line == f"error: {NO_ADDRESS}"
