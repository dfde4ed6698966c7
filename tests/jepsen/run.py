"""One run: robots at work, faults, then quiet, an end to everything, and the judgement."""

from __future__ import annotations

import contextlib
import itertools
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psycopg

from .checker import Facts, Row, Violation, check, given, leases_not_kept, table, unsettled
from .cluster import Cluster, wait_for
from .history import Entry, History
from .nemesis import Nemesis
from .watcher import Watcher
from .workload import LEASE_S, Workload

_WARM_UP_S, _SETTLE_S = 60.0, 180.0
_COLUMNS = ("state", "reason", "replaces", "restarts", "site", "service", "robot", "spare")
_KEYS = "ARRAY(SELECT key FROM idempotency WHERE instance = id)"
_INSTANCES = f"SELECT id, {_KEYS}, {', '.join(_COLUMNS)} FROM instances"
_EVENTS = "SELECT id, instance, state, reason FROM events ORDER BY id"


@dataclass(frozen=True)
class Result:
    seed: int
    folder: Path
    rows: Sequence[Row]
    violations: Sequence[Violation]
    instances: int
    moves: int
    given: int
    """Standbys that a robot got."""
    leases_not_kept: int

    def text(self) -> str:
        """The table, and all violations."""
        head = ("fault", "times", "violations", "longest gap without a leader", "longest wait for a service")
        lines = [head] + [
            (r.fault, str(r.times), str(len(r.violations)), f"{r.gap_s:.1f} s", f"{r.wait_s:.1f} s") for r in self.rows
        ]
        widths = [max(len(line[column]) for line in lines) for column in range(len(head))]
        told = ["  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)) for line in lines]
        told += [f"{v.t:8.1f} s  {v.rule}: {v.text}" for v in self.violations]
        count = f"{len(self.violations)} violations in {self.instances} instances"
        count += f" ({self.moves} moves, {self.given} standbys given)"
        more = f"{self.leases_not_kept} leases ran out of robots that asked and got no answer"
        return "\n".join([*told, f"{count}; {more}; seed {self.seed}; history and logs: {self.folder}"])


def run(
    cluster: Cluster,
    seed: int,
    faults: Callable[[Nemesis], Iterable[tuple[str, ...]]],
    *,
    say: Callable[[str], None] = lambda _: None,
) -> Result:
    """Strike with what ``faults`` yields, and judge; gives what came of it."""
    history = History(cluster.folder / "history.jsonl")
    watcher = Watcher(cluster, history)
    try:
        cluster.inside(lambda: _work(cluster, watcher, history, seed, faults, say))
    finally:
        watcher.close()
        history.close()
    return judge(history.entries, seed, cluster.folder)


def judge(history: Sequence[Entry], seed: int, folder: Path) -> Result:
    facts = Facts(history)
    moves = len({answer["id"] for _, answer in facts.answered("migrate")})
    counts = len(facts.stored), moves, len(given(facts)), leases_not_kept(facts)
    return Result(seed, folder, table(history), check(history), *counts)


def timed(names: Sequence[str], seconds: float, pairs: bool) -> Callable[[Nemesis], Iterable[tuple[str, ...]]]:
    """Faults as long as there is time."""
    deadline = time.monotonic() + seconds

    def faults(nemesis: Nemesis) -> Iterable[tuple[str, ...]]:
        plan = nemesis.plan(names, pairs)
        return itertools.takewhile(lambda _: time.monotonic() < deadline, plan)

    return faults


def _work(
    cluster: Cluster,
    watcher: Watcher,
    history: History,
    seed: int,
    faults: Callable[[Nemesis], Iterable[tuple[str, ...]]],
    say: Callable[[str], None],
) -> None:
    workload = Workload(cluster, history, seed)
    nemesis = Nemesis(cluster, watcher, history, seed)
    places = ["processes"] + (["containers"] if cluster.engine else [])
    wait_for(lambda: watcher.leaders and all(watcher.runs.get(place) for place in places), _WARM_UP_S)
    for names in faults(nemesis):
        say(" + ".join(names))
        nemesis.strike(*names)
    cluster.heal()
    workload.quiesce()
    say("settling")
    time.sleep(LEASE_S)  # whom nobody keeps is gone then
    _settle(cluster, history, "settled")
    cluster.end_standbys()
    workload.drain()
    _settle(cluster, history, "drained")
    workload.close(patience=30)


def _settle(cluster: Cluster, history: History, when: str) -> None:
    """Note how it is in the end: as soon as all is as it should be, or when patience has ended."""
    deadline = time.monotonic() + _SETTLE_S
    while True:
        final = _look(cluster, when)
        if final is not None and (not unsettled(final) or time.monotonic() > deadline):
            history.add(**final)
            return
        assert time.monotonic() < deadline + _SETTLE_S, "neither database nor engine answer"
        time.sleep(0.5)


def _look(cluster: Cluster, when: str) -> dict[str, Any] | None:
    """What the database has, and what runs; None: one of them does not answer."""
    import docker

    with contextlib.suppress(psycopg.Error, docker.errors.DockerException):
        before = dict(cluster.processes()) | cluster.containers()
        names = ("keys", *_COLUMNS)
        instances = {row[0]: dict(zip(names, row[1:], strict=True)) for row in cluster.sql(_INSTANCES)}
        runs = dict(cluster.processes()) | cluster.containers()
        if before == runs:
            events = [list(row) for row in cluster.sql(_EVENTS)]
            told = {"instances": instances, "events": events, "runs": runs, "standbys": cluster.standbys}
            return {"kind": "final", "when": when, **told}
    return None
