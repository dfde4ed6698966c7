"""Orchestrators that are replaced one after the other, by newer ones, while robots are served. Real programs."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from newer_code import newer_code
from orchestrator_program import PATIENCE, Program, environment, until, with_toy

from skytether.api.client import ApiError, Client, Unreachable
from skytether.api.rest import InstanceCreate, SiteCreate, State
from skytether.orchestrator.config.settings import Timing
from skytether.orchestrator.store.engine import make_engine, migrate

pytestmark = pytest.mark.slow

PERIOD_S = 0.05


class OneAddress:
    """A proxy for TCP: each connection goes to the next of those behind it that takes it."""

    def __init__(self, ports: list[int]) -> None:
        self._ports = ports
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self._listener.getsockname()[1]}"
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                here, _ = self._listener.accept()
                threading.Thread(target=self._serve, args=(here,), daemon=True).start()

    def _serve(self, here: socket.socket) -> None:
        self._ports.append(self._ports.pop(0))
        for port in list(self._ports):
            with contextlib.suppress(OSError):
                there = socket.create_connection(("127.0.0.1", port))
                back = threading.Thread(target=pump, args=(there, here), daemon=True)
                with here, there:
                    back.start()
                    pump(here, there)
                    back.join()
                return
        here.close()


def pump(source: socket.socket, sink: socket.socket) -> None:
    with contextlib.suppress(OSError):
        while data := source.recv(65536):
            sink.sendall(data)
    for end in (source, sink):
        with contextlib.suppress(OSError):
            end.shutdown(socket.SHUT_RDWR)


class Traffic:
    """Calls something again and again, from a thread of its own, and keeps what went wrong."""

    def __init__(self, call: Callable[[], object]) -> None:
        self.done = 0
        self.failed: list[str] = []
        self._call = call
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.wait(PERIOD_S):
            try:
                self._call()
                self.done += 1
            except Exception as error:
                self.failed.append(repr(error))

    def end(self) -> None:
        self._stop.set()
        self._thread.join()


def retried(call: Callable[[], Any]) -> Any:
    """As the documentation tells clients: what was answered with 503, or not at all, is tried again for a while."""
    began = time.monotonic()
    while True:
        try:
            return call()
        except (ApiError, Unreachable) as error:
            again = isinstance(error, Unreachable) or error.problem.status == 503
            if not again or time.monotonic() - began > PATIENCE:
                raise
            time.sleep(0.1)


@pytest.fixture
def newer(tmp_path: Path, postgres: str) -> Path:
    """A source root with this very code and one migration more."""
    engine = make_engine(postgres)
    head = migrate(engine)
    engine.dispose()
    return newer_code(tmp_path / "newer", head)


def free_ports(count: int) -> list[int]:
    with contextlib.ExitStack() as stack:
        return [stack.enter_context(socket.create_server(("127.0.0.1", 0))).getsockname()[1] for _ in range(count)]


@pytest.fixture
def pair(tmp_path: Path, postgres: str) -> Iterator[list[Program]]:
    (tmp_path / "secrets").mkdir(mode=0o700)
    programs = []
    for port in free_ports(2):
        (tmp_path / str(port)).mkdir()
        shared = ("--database", postgres, "--secrets-dir", str(tmp_path / "secrets"), "--port", str(port))
        programs.append(Program(tmp_path / str(port) / "state", *shared))
    yield programs
    for program in programs:
        program.clean_up()
    for pid in services(tmp_path / "instances"):
        os.kill(pid, signal.SIGKILL)


def services(folder: Path) -> set[int]:
    mine = b"SKYTETHER_GRANT=" + os.fsencode(folder)
    return {int(p.name) for p in Path("/proc").glob("[0-9]*") if mine in environment(p)}


def url(program: Program) -> str:
    return f"http://127.0.0.1:{program.options[-1]}"


def start(program: Program) -> None:
    program.spawn()
    until(lambda: (program.folder / "address").exists(), program)


def replace(program: Program, other: Program, code: Path, *, leads: bool) -> float:
    """End one while the other serves, and start it anew from other code; seconds until the other one led."""
    before, began = other.log.count("this orchestrator leads:"), time.monotonic()
    assert program.end() == 0
    if leads:
        until(lambda: other.log.count("this orchestrator leads:") > before)
    gap = time.monotonic() - began if leads else 0.0
    program.code = code
    start(program)
    return gap


@pytest.mark.postgres
def test_a_rolling_update_to_a_new_schema_is_noticed_by_nobody(
    pair: list[Program], newer: Path, manifest: Any, tmp_path: Path
) -> None:
    one, two = pair
    start(one)
    start(two)
    token = (tmp_path / "secrets/operator.token").read_text().strip()
    proxy = OneAddress([int(program.options[-1]) for program in pair])
    traffic: list[Traffic] = []
    with contextlib.ExitStack() as stack:
        stack.callback(proxy.close)

        def connect(address: str) -> Client:
            return stack.enter_context(Client(address, token))

        operator = with_toy(connect(f"{url(one)},{url(two)}"), manifest)
        folder = {"folder": str(tmp_path / "instances")}
        operator.create_site(SiteCreate(name="shared", tier="cloud", runtime="process", options=folder))
        operator.delete_site("local")
        ask = InstanceCreate(robot="walker", service="toy", lease_s=60)
        held = [operator.wait_running(operator.create_instance(ask).id) for _ in range(2)]
        pids = services(tmp_path / "instances")
        assert len(pids) == 2

        asked: list[str] = []
        through = connect(proxy.url)

        def come_and_go() -> None:
            key = f"key {len(asked)}"
            again = [retried(lambda: through.create_instance(ask, idempotency_key=key)).id for _ in range(2)]
            assert again[0] == again[1]
            asked.append(again[0])
            retried(lambda: through.delete_instance(again[0]))

        for robot, mine in zip(
            (connect(f"{url(one)},{url(two)}"), connect(f"{url(two)},{url(one)}")), held, strict=True
        ):
            traffic.append(Traffic(lambda robot=robot, mine=mine: retried(lambda: robot.renew_instance(mine.id))))  # type: ignore[misc]
        traffic += [Traffic(come_and_go), Traffic(lambda: retried(through.instances))]
        seen: list[str] = []

        def watch() -> None:
            try:
                seen.extend(event.state for event in connect(proxy.url).watch(held[0].id, timeout=120))
            except Exception as error:
                seen.append(repr(error))

        log: list[str] = []

        def follow() -> None:
            try:
                log.extend(connect(proxy.url).follow_logs(held[0].id, on_resume=lambda: log.append("(again) ")))
            except Exception as error:
                log.append(repr(error))

        followers = [threading.Thread(target=stream, daemon=True) for stream in (watch, follow)]
        for follower in followers:
            follower.start()
        try:
            handed_over = replace(one, two, newer, leads=True)
            # The other one, which leads still, finds another schema under its feet.
            until(lambda: "this orchestrator leads:" in one.log.partition("listening")[2], one)
            web = stack.enter_context(httpx.Client(base_url=url(two), verify=False))
            until(lambda: web.get("/readyz").status_code == 503, two)
            assert "a newer orchestrator has brought the database to its schema" in web.get("/readyz").json()["detail"]
            replace(two, one, newer, leads=False)
        finally:
            for stream in traffic:
                stream.end()
        assert [stream.failed for stream in traffic] == [[]] * 4
        assert all(stream.done > 10 for stream in traffic), [stream.done for stream in traffic]
        assert handed_over < 10
        assert services(tmp_path / "instances") >= pids, "nothing was stopped"
        for mine in held:
            after = operator.get_instance(mine.id)
            assert (after.state, after.restarts, after.session) == (State.RUNNING, 0, mine.session)
        assert len(asked) == len(set(asked))
        assert {i.id for i in operator.instances()} <= {*asked, *(i.id for i in held)}, "nothing was made twice"
        until(lambda: services(tmp_path / "instances") == pids)
        operator.delete_instance(held[0].id)
        for follower in followers:
            follower.join(30)
        until(lambda: operator.get_instance(held[0].id).state is State.STOPPED)
    assert seen == ["pending", "placing", "starting", "running", "stopping", "stopped"], "one stream, over all of it"
    assert not any(follower.is_alive() for follower in followers)
    shown = set("".join(log).split("(again) ")) - {""}  # of a connection that ended before its first line
    assert shown == {"toy service\n"}, "so is the log, once for each connection"
    assert "(again) " in log
    assert "Traceback" not in one.log + two.log
    status, line = old_over_new(pair[0])
    assert status == 1
    assert "a newer orchestrator has brought the database to its schema" in line


@pytest.mark.postgres
def test_what_a_newer_one_has_changed_the_database_of_refuses_and_does_nothing(
    served_with: Callable[..., Any], postgres: str
) -> None:
    served = served_with(database_url=postgres, timing=Timing(outdated_grace=0))
    operator, core = served.operator, served.core
    until(lambda: core.leadership.leads)
    engine = make_engine(postgres)

    def schema(*statements: str) -> None:
        with engine.begin() as connection:
            for statement in statements:
                connection.exec_driver_sql(statement)

    head = migrate(engine)
    schema("ALTER TABLE services RENAME manifest TO later", "UPDATE alembic_version SET version_num = '9001'")
    sentence = "a newer orchestrator has brought the database to its schema: ask that one"
    with pytest.raises(ApiError, match=sentence) as caught:
        operator.services()  # at once, whatever it knows yet
    assert caught.value.problem.status == 503
    with pytest.raises(ApiError, match=sentence):
        operator.sites()
    until(lambda: not core.leadership.leads)
    schema("ALTER TABLE services RENAME later TO manifest", f"UPDATE alembic_version SET version_num = '{head}'")
    engine.dispose()
    until(lambda: core.leadership.leads)
    assert [m.metadata.name for m in operator.services() if m.metadata.name == "toy"] == ["toy"]


def old_over_new(program: Program) -> tuple[int, str]:
    """What an old one says that is started over the new schema."""
    program.end()
    program.code = None
    (program.folder.parent / "log").write_text("")
    return program.fails()
