"""Looks at the machine while others ask and break things: what lives, and who says that it leads."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable

import psycopg
from nothing_lost import Runs

from .cluster import Cluster, Member
from .history import History

_LEADS = re.compile(rb"this orchestrator leads: [^\n]*\(epoch (\d+)\)")
_LEADER = "SELECT epoch FROM leadership WHERE until > extract(epoch FROM clock_timestamp())"
_TRACEBACK = re.compile(
    rb"^(\d{4}-[^\n]*\nTraceback \(most recent call last\)[^\n]*(?:\n(?!\d{4}-)[^\n]*)*)", re.MULTILINE
)
_PROCESSES_S, _CONTAINERS_S, _LEADERS_S = 0.1, 0.25, 0.05
_HANGS_S = 0.5
"""A database that takes so long for an answer has hung."""


def live_together(look: Runs) -> dict[str, list[str]]:
    """What lives at one moment. A look takes some time: one of two runs may have ended before the other began.

    Who is there in two looks one after the other was there between them, and so was the other one.
    """
    first = look()
    if all(len(names) < 2 for names in first.values()):
        return dict(first)
    second = look()
    return {i: [name for name in names if len(names) < 2 or name in second.get(i, [])] for i, names in first.items()}


class Log:
    """What an orchestrator wrote since the last look."""

    def __init__(self, member: Member) -> None:
        self._path = member.folder.parent / "log"
        self._read = 0

    def look(self) -> tuple[list[int], list[str]]:
        """Epochs in which it began to lead, and tracebacks with the line before."""
        with self._path.open("rb") as file:
            file.seek(self._read)
            text = file.read()
        whole = text.rfind(b"\n") + 1
        self._read, text = self._read + whole, text[:whole]
        epochs = [int(epoch) for epoch in _LEADS.findall(text)]
        return epochs, [line.decode(errors="replace") for line in _TRACEBACK.findall(text)]


class Watcher:
    """Three threads."""

    def __init__(self, cluster: Cluster, history: History) -> None:
        self._cluster, self._history = cluster, history
        self.leaders: list[int] = []
        """The one that leads by the database and its clock, and can: it is not dead, paused or cut off."""
        self.answered = True
        """Whether the database did when it was asked last who leads."""
        self._epochs: dict[int, int] = {}
        """Who led in each."""
        self._database: psycopg.Connection[tuple[int]] | None = None
        self.runs: dict[str, dict[str, list[str]]] = {}
        """By place, what lives there."""
        self._end = threading.Event()
        self._logs = [Log(member) for member in cluster.members]
        self._threads = [
            cluster.thread(lambda: self._again(_LEADERS_S, self._look_at_leaders), "leaders"),
            cluster.thread(lambda: self._again(_PROCESSES_S, self._look_at_processes), "processes"),
        ]
        if cluster.engine is not None:
            self._threads.append(
                cluster.thread(lambda: self._again(_CONTAINERS_S, self._look_at_containers), "containers")
            )

    def close(self) -> None:
        self._end.set()
        for thread in self._threads:
            thread.join()
        self._forget_database()

    def _again(self, period: float, look: Callable[[], None]) -> None:
        while not self._end.wait(period):
            look()

    def _look_at_leaders(self) -> None:
        for number, log in enumerate(self._logs):
            epochs, tracebacks = log.look()
            self._epochs |= dict.fromkeys(epochs, number)
            for line in tracebacks:
                self._history.add("traceback", line=line)
        asked = self._history.now()
        epoch = self._epoch()
        if self._history.now() - asked > _HANGS_S:
            self._note_leaders([], asked)
        # That it leads is in its log a moment later.
        leader = self._epochs.get(epoch)
        acts = leader is not None and self._cluster.members[leader].acts
        self._note_leaders([leader] if leader is not None and acts else [])

    def _epoch(self) -> int:
        """Of who leads now; 0: nobody."""
        try:
            if self._database is None:
                self._database = self._cluster.connect()
            row = self._database.execute(_LEADER).fetchone()
        except psycopg.Error:
            self._forget_database()
            self.answered = False
            return 0
        self.answered = True
        return row[0] if row else 0

    def _forget_database(self) -> None:
        if self._database is not None:
            self._database.close()
            self._database = None

    def _note_leaders(self, leaders: list[int], since: float | None = None) -> None:
        if leaders != self.leaders:
            self.leaders = leaders
            self._history.add("leader", leaders=leaders, **({} if since is None else {"t": since}))

    def _look_at_processes(self) -> None:
        self._note("processes", live_together(self._cluster.processes))

    def _look_at_containers(self) -> None:
        import docker
        import requests

        try:
            runs = live_together(self._cluster.containers)
        except (docker.errors.DockerException, requests.RequestException):
            return  # the engine is what is broken just now
        self._note("containers", runs)

    def _note(self, place: str, runs: dict[str, list[str]]) -> None:
        if runs != self.runs.get(place):
            self.runs[place] = runs
            self._history.add("look", place=place, runs=runs)
