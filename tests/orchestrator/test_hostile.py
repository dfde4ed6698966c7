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
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from orchestrator_program import Program, until, with_toy

from skytether.api.client import ApiError, Client, Unreachable
from skytether.api.rest import InstanceCreate, RobotCreate, State

pytestmark = pytest.mark.slow

LEASE = 3.0
"""Seconds; an attack lasts for several of them."""
ATTACK = 6.0
SLOW_BODY = b"POST /api/v1/instances HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\nContent-Length: 1000\r\n"


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
        self.client = Client((program.folder / "address").read_text().strip(), token)
        made = self.client.create_instance(InstanceCreate(robot=name, service="toy", lease_s=LEASE))
        self.instance = self.client.wait_running(made.id).id
        self.took: list[float] = []
        """Seconds for each renewal that was granted."""
        self.refused: list[str] = []

    def renew_for(self, seconds: float, every: float = LEASE / 4) -> None:
        end = time.monotonic() + seconds
        while (began := time.monotonic()) < end:
            try:
                renewed = self.client.renew_instance(self.instance)
                assert renewed.state is State.RUNNING, f"{renewed.state}: {renewed.reason}\n{self._program.log}"
                self.took.append(time.monotonic() - began)
            except (ApiError, Unreachable) as error:
                self.refused.append(str(error))
            time.sleep(every)

    def still_has_it(self) -> bool:
        return self.client.get_instance(self.instance).state is State.RUNNING


@pytest.fixture
def honest(program: Program, manifest: Any) -> Iterator[Honest]:
    with with_toy(program.start(), manifest) as operator:
        robot = Honest(program, operator)
        with robot.client:
            yield robot


@contextlib.contextmanager
def many(address: tuple[str, int], count: int, first: bytes = b"") -> Iterator[list[socket.socket]]:
    """Connections that were opened, and perhaps began to say something; who is refused stays refused."""
    held: list[socket.socket] = []
    try:
        for _ in range(count):
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
        assert max(honest.took) < 2.0  # alone a few milliseconds; the machine may be busy


def test_a_robots_own_slow_bodies_cost_only_itself(program: Program, honest: Honest, manifest: Any) -> None:
    operator = Client(
        (program.folder / "address").read_text().strip(), (program.folder / "operator.token").read_text().strip()
    )
    hostile = operator.create_robot(RobotCreate(name="hostile")).token
    with operator, many(address_of(program), 300, SLOW_BODY + f"Authorization: Bearer {hostile}\r\n\r\n".encode()):
        honest.renew_for(ATTACK)
        assert honest.refused == []
        assert honest.still_has_it()


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
    with many(address_of(program), 600, SLOW_BODY + b"\r\n"):
        until(lambda: not honest.still_has_it(), program)
