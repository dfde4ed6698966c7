"""The nemesis breaks what it is to break, and no more: with made-up orchestrators."""

from __future__ import annotations

import os
import random
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from engine_ways import EngineProxy

from . import cluster as programs
from .history import History
from .nemesis import FAULTS, Nemesis


class Member:
    def __init__(self, number: int) -> None:
        self.number, self.host, self.paused = number, "", False
        self.runs = self.starts = True

    def end(self, _signal: int = 0) -> None:
        self.runs = False

    def spawn(self) -> None:
        self.runs = self.starts

    def ready(self) -> bool:
        return self.runs


class Cluster:
    """The database is away: nobody leads, and whoever starts ends at once."""

    def __init__(self) -> None:
        self.members = [Member(number) for number in range(3)]
        self.leaders: list[int] = []
        self.answered = False
        for member in self.members:
            member.starts = False

    def sql(self, *_: Any) -> None:
        """Asked in vain."""

    def database_is_back(self) -> None:
        self.leaders, self.answered = [1], True
        for member in self.members:
            member.starts = True


@pytest.fixture
def nobody_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    def waits(_: float) -> None:
        raise AssertionError("it waits")

    # Of this module alone: threads that other tests left may sleep.
    monkeypatch.setattr(programs, "time", SimpleNamespace(monotonic=time.monotonic, sleep=waits))


@pytest.mark.usefixtures("nobody_waits")
@pytest.mark.parametrize("name", ["end-leadership", "kill-leader", "rolling-restart"])
def test_without_a_database_nobody_waits_for_a_leader(name: str) -> None:
    made: Any = Cluster()
    FAULTS[name](made, made, random.Random(1)).begin()


@pytest.mark.usefixtures("nobody_waits")
def test_orchestrators_that_ended_are_started_again() -> None:
    made: Any = Cluster()
    nemesis = Nemesis(made, made, History(), 1)
    FAULTS["rolling-restart"](made, made, random.Random(1)).begin()
    assert not nemesis.well()
    assert [member.runs for member in made.members] == [False] * 3
    made.database_is_back()
    assert nemesis.well()
    assert [member.runs for member in made.members] == [True] * 3


@pytest.fixture
def proxy(tmp_path: Path) -> Iterator[EngineProxy]:
    """To an engine that greets whoever comes."""
    with socket.socket(socket.AF_UNIX) as engine:
        engine.bind(str(tmp_path / "engine"))
        engine.listen()

        def greet() -> None:
            with suppress(OSError):
                while True:
                    with engine.accept()[0] as one:
                        one.sendall(b"hello")
                        one.recv(1)

        threading.Thread(target=greet, daemon=True).start()
        proxy = EngineProxy(tmp_path / "proxy", target=str(tmp_path / "engine"))
        proxy.start()
        yield proxy
        proxy.cut()
        engine.shutdown(socket.SHUT_RDWR)


_ASK = """\
import socket, sys
with socket.socket(socket.AF_UNIX) as one:
    one.settimeout(30)
    one.connect(sys.argv[1])
    print(one.recv(9).decode())
"""


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2], ids=["silent", "refused"])
def test_the_leader_alone_is_cut_from_the_engine(proxy: EngineProxy, seed: int) -> None:
    made: Any = Cluster()
    made.leaders, made.proxy, made.members[1].pid = [1], proxy, os.getpid()
    fault = FAULTS["leader-site-cut"](made, made, random.Random(seed))
    with _connected(proxy) as before:
        assert before.recv(9) == b"hello"
        fault.begin()
        assert before.recv(9) == b""
    with _connected(proxy) as now:
        if seed == 1:
            now.settimeout(0.2)
            with pytest.raises(TimeoutError):
                now.recv(9)
        other = [sys.executable, "-c", _ASK, _socket(proxy)]
        assert subprocess.run(other, capture_output=True, text=True, check=True).stdout == "hello\n"
        fault.heal()
        now.settimeout(30)
        assert now.recv(9) == b""
    with _connected(proxy) as after:
        assert after.recv(9) == b"hello"


def _connected(proxy: EngineProxy) -> socket.socket:
    one = socket.socket(socket.AF_UNIX)
    one.settimeout(30)
    one.connect(_socket(proxy))
    return one


def _socket(proxy: EngineProxy) -> str:
    return proxy.engine.removeprefix("unix://")
