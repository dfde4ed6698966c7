"""The real orchestrator under attack from loopback: who did nothing loses nothing.

Each attack is given what an attacker on the network has, and the assertion is about somebody else: a robot that renews
a short lease all the while.
"""

from __future__ import annotations

import contextlib
import resource
import signal
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path
from statistics import median
from typing import Any
from urllib.parse import urlsplit

import httpx
import psutil
import pytest
from orchestrator_program import Program, until, with_toy

from skytether.api.client import ApiError, Client, Unreachable
from skytether.api.rest import SCOPES, InstanceCreate, RobotCreate, State, TokenCreate

pytestmark = pytest.mark.slow

LEASE = 3.0
"""Seconds; an attack lasts for longer."""
ATTACK = 4.5
SLOW_BODY = (
    b"POST /api/v1/instances HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: 1000\r\n"
)


def address_of(program: Program) -> tuple[str, int]:
    url = urlsplit((program.folder / "address").read_text().strip())
    return url.hostname or "", url.port or 0


@pytest.fixture
def many_files() -> Iterator[None]:
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(4096, before[1]), before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, before)


@pytest.fixture
def program(tmp_path: Path, many_files: None) -> Iterator[Program]:
    (tmp_path / "one").mkdir()
    made = Program(tmp_path / "one" / "state", "--stop-instances")
    yield made
    made.clean_up()


class Honest:
    """A robot with an instance, which renews it in time."""

    def __init__(self, program: Program, operator: Client, name: str = "walker") -> None:
        token = operator.create_robot(RobotCreate(name=name)).token
        self._program = program
        self.token = token
        self.url = (program.folder / "address").read_text().strip()
        self.client = Client(self.url, token)
        made = self.client.create_instance(InstanceCreate(robot=name, service="toy", lease_s=LEASE))
        self.instance = self.client.wait_running(made.id).id
        self.took: list[float] = []
        """Seconds for each renewal that was granted."""
        self.refused: list[str] = []

    def renew_for(self, seconds: float, every: float = LEASE / 4) -> None:
        """Each time over a connection of its own, as after a time without radio: one that is open is in already."""
        end = time.monotonic() + seconds
        while (began := time.monotonic()) < end:
            try:
                with Client(self.url, self.token) as client:
                    renewed = client.renew_instance(self.instance)
                assert renewed.state is State.RUNNING, f"{renewed.state}: {renewed.reason}\n{self._program.log}"
                self.took.append(time.monotonic() - began)
            except (ApiError, Unreachable) as error:
                self.refused.append(str(error))
            time.sleep(every)

    def was_in_time(self) -> None:
        """Alone each takes milliseconds, under attack each took 7 s. A busy machine makes a single one wait."""
        assert median(self.took) < 2.0
        assert max(self.took) < 5.0

    def still_has_it(self) -> bool:
        return self.client.get_instance(self.instance).state is State.RUNNING


@pytest.fixture
def honest(program: Program, manifest: Any) -> Iterator[Honest]:
    with with_toy(program.start(), manifest) as operator:
        robot = Honest(program, operator)
        with robot.client:
            yield robot


class Hostile:
    """A robot that was registered like any other, and does what it likes with its token."""

    def __init__(self, program: Program, operator: Client, name: str = "hostile") -> None:
        self.token = operator.create_robot(RobotCreate(name=name)).token
        self.url = (program.folder / "address").read_text().strip()
        self.name = name
        self.statuses: Counter[int] = Counter()
        with Client(self.url, self.token) as client:
            made = client.create_instance(InstanceCreate(robot=name, service="toy", lease_s=60))
            self.instance = client.wait_running(made.id).id

    @contextlib.contextmanager
    def again_and_again(self, threads: int, path: str, body: Callable[[int], Any]) -> Iterator[None]:
        """Post to an address from several threads at once, each time something else, as fast as it is answered."""
        over = threading.Event()
        numbers = count()

        def ask() -> None:
            headers = {"Authorization": f"Bearer {self.token}"}
            with httpx.Client(base_url=self.url, headers=headers, trust_env=False, timeout=60) as http:
                while not over.is_set():
                    with contextlib.suppress(httpx.HTTPError):
                        self.statuses[http.post(path, json=body(next(numbers))).status_code] += 1

        running = [threading.Thread(target=ask) for _ in range(threads)]
        for one in running:
            one.start()
        try:
            yield
        finally:
            over.set()
            for one in running:
                one.join()


def operator_of(program: Program) -> Client:
    return Client(
        (program.folder / "address").read_text().strip(), (program.folder / "operator.token").read_text().strip()
    )


@contextlib.contextmanager
def many(address: tuple[str, int], number: int, first: bytes = b"") -> Iterator[list[socket.socket]]:
    """Connections that were opened, and perhaps began to say something; who is refused stays refused."""
    held: list[socket.socket] = []
    try:
        for _ in range(number):
            with contextlib.suppress(OSError):
                held.append(socket.create_connection(address, timeout=2.0))
                held[-1].sendall(first)
        yield held
    finally:
        for one in held:
            one.close()


def closed(one: socket.socket) -> bool:
    """Whether the other end has closed it."""
    one.setblocking(False)
    try:
        while chunk := one.recv(65_536):
            assert chunk
        return True
    except BlockingIOError:
        return False
    except OSError:
        return True


@pytest.mark.parametrize(
    "head",
    [
        SLOW_BODY + b"\r\n",
        SLOW_BODY + b"Authorization: Bearer sky-" + b"0" * 64 + b"\r\n\r\n",
        b"POST /api/v1/inst",
        b"",
    ],
    ids=["no token", "wrong token", "half a head", "nothing"],
)
def test_who_says_nothing_more_costs_nobody_anything(program: Program, honest: Honest, head: bytes) -> None:
    with many(address_of(program), 600, head):
        honest.renew_for(ATTACK)
        assert honest.refused == []
        assert honest.still_has_it()
        honest.was_in_time()


def test_who_asks_before_the_last_answer_came_is_answered_once(program: Program, honest: Honest) -> None:
    assert program.process is not None
    memory = psutil.Process(program.process.pid).memory_info
    before, stop = memory().rss, threading.Event()
    asked = b"GET /openapi.json HTTP/1.1\r\nHost: localhost\r\n\r\n" * 20_000

    def ask_on() -> None:
        while not stop.wait(0.05):
            with contextlib.suppress(OSError), socket.create_connection(address_of(program), timeout=1.0) as one:
                one.sendall(asked)

    attackers = [threading.Thread(target=ask_on) for _ in range(4)]
    for attacker in attackers:
        attacker.start()
    try:
        honest.renew_for(ATTACK)
    finally:
        stop.set()
        for attacker in attackers:
            attacker.join()
    assert honest.refused == []
    honest.was_in_time()
    assert memory().rss - before < 100 << 20


def test_a_robots_own_slow_bodies_cost_only_itself(program: Program, honest: Honest, manifest: Any) -> None:
    operator = operator_of(program)
    hostile = operator.create_robot(RobotCreate(name="hostile")).token
    with operator, many(address_of(program), 300, SLOW_BODY + f"Authorization: Bearer {hostile}\r\n\r\n".encode()):
        honest.renew_for(ATTACK)
        assert honest.refused == []
        assert honest.still_has_it()


@pytest.fixture
def hostile(program: Program, honest: Honest) -> Hostile:
    with operator_of(program) as operator:
        return Hostile(program, operator)


@pytest.mark.parametrize("names", [12, 3000, 8000])
def test_names_that_a_robot_makes_up_cost_only_itself(
    program: Program, honest: Honest, hostile: Hostile, names: int
) -> None:
    def invented(number: int) -> Any:
        return {"measurements": {f"s{number}-{n}": {"rtt_ms": 1} for n in range(names)}}

    assert program.process is not None
    memory = psutil.Process(program.process.pid).memory_info
    before = memory().rss
    with hostile.again_and_again(12, f"/api/v1/instances/{hostile.instance}/renew", invented):
        honest.renew_for(2 * ATTACK)
    assert honest.refused == []
    assert honest.still_has_it()
    honest.was_in_time()
    assert memory().rss - before < 100 << 20


def test_the_key_of_a_session_is_its_robots_alone_and_handed_out_once(program: Program, honest: Honest) -> None:
    with operator_of(program) as operator:
        everything_else = [scope for scope in SCOPES if scope != "sessions"]
        for_keys = operator.create_token(TokenCreate(name="keys", scopes=("sessions",))).token
        curious = operator.create_token(TokenCreate(name="curious", scopes=tuple(everything_else))).token
    with Client(honest.url, curious) as client:
        seen = client.get_instance(honest.instance).session
        assert seen is not None
        assert seen.key is None
        assert seen.port is not None
        renewed = client.renew_instance(honest.instance).session
        assert renewed is not None
        assert renewed.key is None
        with pytest.raises(ApiError, match="needs the scope 'sessions'"):
            client.claim_session(honest.instance, "c" * 16)
    key = honest.client.claim_session(honest.instance, "my own secret claim")
    thief = Client(honest.url, honest.token)  # a token that leaked
    with thief, pytest.raises(ApiError, match="handed out already, and not to you"):
        thief.claim_session(honest.instance, "another claim, of mine")
    assert honest.client.claim_session(honest.instance, "my own secret claim") == key  # the answer was lost
    program.end(signal.SIGKILL)
    with program.start(), Client((program.folder / "address").read_text().strip(), honest.token) as again:
        with pytest.raises(ApiError, match="handed out already, and not to you"):
            again.claim_session(honest.instance, "another claim, of mine")
        with Client((program.folder / "address").read_text().strip(), for_keys) as client:
            assert client.claim_session(honest.instance, "any claim will do") == key


def test_instances_and_streams_that_a_robot_asks_for_starve_nobody(
    program: Program, honest: Honest, hostile: Hostile
) -> None:
    asked = {"robot": hostile.name, "service": "toy", "lease_s": 3600}
    # The operator counts: the robot's own budget of requests is spent.
    with operator_of(program) as operator, contextlib.ExitStack() as streams:
        with hostile.again_and_again(4, "/api/v1/instances", lambda _: asked):
            honest.renew_for(ATTACK)
        assert sum(instance.robot == hostile.name for instance in operator.instances()) == 16
        assert set(hostile.statuses) <= {201, 409, 429}
        path = f"/api/v1/instances/{hostile.instance}/logs?follow=true&tail=1"
        head = f"GET {path} HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {hostile.token}\r\n\r\n"
        streams.enter_context(many(address_of(program), 200, head.encode()))
        honest.renew_for(ATTACK)
    assert honest.refused == []
    assert honest.still_has_it()
    honest.was_in_time()


TWICE = [{"$ref": f"#/$defs/d{level + 1}"} for level in range(30)]
SCHEMAS = {
    "pattern": {"type": "string", "pattern": "^(a+)+$"},
    "dialect": {"$schema": "https://json-schema.org/draft/2020-12/schema", "pattern": "^(a+)+$"},
    "references": {"$ref": "#/$defs/d0"},
}


@pytest.mark.parametrize("kind", SCHEMAS)
def test_a_pattern_or_a_schema_freezes_nobody(kind: str, program: Program, honest: Honest, hostile: Hostile) -> None:
    definitions = {f"d{level}": {"anyOf": [next_one, next_one]} for level, next_one in enumerate(TWICE)}
    schema = {"$defs": {**definitions, "d30": {"type": "number"}}, "properties": {"name": SCHEMAS[kind]}}
    evil = {"apiVersion": "skytether.io/v1", "kind": "Service", "metadata": {"name": "evil"}}
    with operator_of(program) as operator:
        operator.put_service("evil", {**evil, "spec": {"entrypoint": "x", "params": schema}})
    asked = {"robot": hostile.name, "service": "evil", "params": {"name": "a" * 30 + "!"}}
    with hostile.again_and_again(4, "/api/v1/instances", lambda _: asked):
        honest.renew_for(ATTACK)
    assert honest.refused == []
    honest.was_in_time()
    assert set(hostile.statuses) <= {422, 429}


@pytest.mark.parametrize("head", [SLOW_BODY + b"\r\n", b"GET /hea", b""], ids=["body", "head", "nothing"])
def test_silent_connections_are_closed(
    program: Program, manifest: Any, head: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    for key in ("HEAD_S", "BODY_S", "IDLE_S"):
        monkeypatch.setenv(f"SKYTETHER_LIMITS_{key}", "1")
    with program.start() as operator, many(address_of(program), 50, head) as held:
        assert operator.sites() is not None
        until(lambda: all(closed(one) for one in held), program)


def test_out_of_files_no_lease_runs_out(program: Program, honest: Honest) -> None:
    assert program.process is not None
    resource.prlimit(program.process.pid, resource.RLIMIT_NOFILE, (64, 64))
    with many(address_of(program), 600, b"GET /hea"):
        honest.renew_for(ATTACK)
    until(honest.still_has_it, program)
    honest.renew_for(2.0)
    assert honest.still_has_it()


def test_an_orchestrator_that_stood_still_ends_nothing(program: Program, honest: Honest) -> None:
    assert program.process is not None
    renewing = threading.Thread(target=honest.renew_for, args=(3 * LEASE,))
    renewing.start()
    program.process.send_signal(signal.SIGSTOP)
    time.sleep(2 * LEASE)
    program.process.send_signal(signal.SIGCONT)
    renewing.join()
    assert honest.still_has_it()


def test_a_robot_that_vanished_loses_its_lease_all_the_same(program: Program, honest: Honest) -> None:
    # The operator looks: nobody is to be refused for looking often.
    with operator_of(program) as operator, many(address_of(program), 600, SLOW_BODY + b"\r\n"):
        until(lambda: operator.get_instance(honest.instance).state is not State.RUNNING, program)
