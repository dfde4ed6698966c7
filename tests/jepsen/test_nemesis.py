"""The nemesis breaks what it is to break, and no more: with made-up orchestrators."""

from __future__ import annotations

import random
from typing import Any

import pytest

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

    monkeypatch.setattr(programs.time, "sleep", waits)


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
    assert not nemesis._well()
    assert [member.runs for member in made.members] == [False] * 3
    made.database_is_back()
    assert nemesis._well()
    assert [member.runs for member in made.members] == [True] * 3
