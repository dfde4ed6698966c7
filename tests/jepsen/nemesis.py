"""Breaks things, and mends them again. What is chosen follows from the seed; when it works does not."""

from __future__ import annotations

import contextlib
import os
import random
import signal
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence

import psycopg
from newer_code import newer_code

from .cluster import Cluster, Member, wait_for
from .history import History
from .watcher import Watcher

HOUR = 3600.0
_PATIENCE = 60.0
_REST_S = 2.0
_ALL_OF = "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE client_addr = %s"
_LEADING = f"{_ALL_OF} AND query LIKE 'UPDATE leadership%%'"


class Fault(ABC):
    """One kind; ``begin`` and ``heal`` are called in turn."""

    def __init__(self, cluster: Cluster, watcher: Watcher, rng: random.Random) -> None:
        self.cluster, self.watcher, self.random = cluster, watcher, rng

    @abstractmethod
    def begin(self) -> list[str]:
        """Break it; gives the instances of which a run was hit."""

    def heal(self) -> None:  # noqa: B027 (many heal by themselves)
        """Mend it."""

    def hold(self) -> float:
        """How long it is left so, in seconds."""
        return self.random.uniform(1, 3)

    def leader(self) -> Member:
        """The one that leads; any one that runs, if nobody does for long, or can: the database was broken first."""
        wait_for(lambda: self.watcher.leaders or not self.watcher.answered, 20)
        leaders = self.watcher.leaders or [m.number for m in self.cluster.members if m.runs and not m.paused] or [0]
        return self.cluster.members[leaders[0]]

    def follower(self) -> Member:
        leader = self.leader()
        return self.random.choice([m for m in self.cluster.members if m is not leader])


class _OfOne(Fault):
    """Something that is done to one orchestrator."""

    victim: Member

    def __init__(self, cluster: Cluster, watcher: Watcher, rng: random.Random, *, leads: bool) -> None:
        super().__init__(cluster, watcher, rng)
        self._leads = leads

    def begin(self) -> list[str]:
        self.victim = self.leader() if self._leads else self.follower()
        self.break_it()
        return []

    def break_it(self) -> None:
        raise NotImplementedError


class Kill(_OfOne):
    """kill -9, and started again."""

    def break_it(self) -> None:
        if self.victim.runs:
            self.victim.end(signal.SIGKILL)

    def heal(self) -> None:
        if not self.victim.runs:
            self.victim.spawn()


class Pause(_OfOne):
    """SIGSTOP, SIGCONT."""

    def hold(self) -> float:
        return self.random.uniform(3, 15)

    def break_it(self) -> None:
        self.victim.pause()

    def heal(self) -> None:
        self.victim.go_on()


class Clock(_OfOne):
    """An hour ahead or behind, and right again."""

    def hold(self) -> float:
        return self.random.uniform(3, 8)

    def break_it(self) -> None:
        self.victim.set_clock(self.random.choice((-HOUR, HOUR)))

    def heal(self) -> None:
        self.victim.set_clock(0)


class Partition(_OfOne):
    """Packets between it and the database are lost, all of them or a third."""

    def __init__(
        self, cluster: Cluster, watcher: Watcher, rng: random.Random, *, leads: bool, percent: int = 100
    ) -> None:
        super().__init__(cluster, watcher, rng, leads=leads)
        self._percent = percent

    def hold(self) -> float:
        return self.random.uniform(4, 20)

    def break_it(self) -> None:
        self.victim.lose(self._percent)

    def heal(self) -> None:
        self.victim.lose(0)


class Connections(_OfOne):
    """The server ends connections of the leader: the one by which it keeps the lead, or all."""

    def __init__(self, cluster: Cluster, watcher: Watcher, rng: random.Random, *, whole: bool) -> None:
        super().__init__(cluster, watcher, rng, leads=True)
        self._whole = whole

    def break_it(self) -> None:
        with contextlib.suppress(psycopg.Error):  # another fault may have taken the server away
            self.cluster.sql(_ALL_OF if self._whole else _LEADING, self.victim.host)


class Restart(_OfOne):
    """Ended politely and started again, as an update does with one after the other."""

    def __init__(self, cluster: Cluster, watcher: Watcher, rng: random.Random) -> None:
        super().__init__(cluster, watcher, rng, leads=True)

    def hold(self) -> float:
        return 0.0

    def break_it(self) -> None:
        first = self.victim.number
        for turn in range(len(self.cluster.members)):
            member = self.cluster.members[(first + turn) % len(self.cluster.members)]
            if member.runs and not member.paused:
                member.end()
                member.spawn()
                # Without the database it ends at once; `Nemesis` starts it again when that is mended.
                wait_for(lambda member=member: member.ready() or not member.runs, _PATIENCE)  # type: ignore[misc]


class Update(Restart):
    """The same to a newer version, whose database has another schema."""

    def break_it(self) -> None:
        [(head,)] = self.cluster.sql("SELECT version_num FROM alembic_version")
        before = self.cluster.members[0].code
        code = newer_code(self.cluster.folder / f"code after {head}", head, before)
        for member in self.cluster.members:
            member.code = code
        super().break_it()


class Database(Fault):
    """The server is killed, stays away for a while, and begins again."""

    def __init__(self, cluster: Cluster, watcher: Watcher, rng: random.Random, *, longest: float) -> None:
        super().__init__(cluster, watcher, rng)
        self._longest = longest

    def hold(self) -> float:
        return self.random.uniform(self._longest / 3, self._longest)

    def begin(self) -> list[str]:
        self.cluster.server.stop()
        return []

    def heal(self) -> None:
        self.cluster.server.start()


class DatabaseHangs(Fault):
    """SIGSTOP for all of the server's processes."""

    def hold(self) -> float:
        return self.random.uniform(3, 15)

    def begin(self) -> list[str]:
        self.cluster.server.signal(signal.SIGSTOP)
        return []

    def heal(self) -> None:
        self.cluster.server.signal(signal.SIGCONT)


class KillServices(Fault):
    """kill -9 of up to three services' processes."""

    def hold(self) -> float:
        return 1.0

    def begin(self) -> list[str]:
        runs = self.watcher.runs.get("processes", {})
        chosen = self.random.sample(sorted(runs), min(3, len(runs)))
        for instance in chosen:
            for session in runs[instance]:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(int(session.split()[1]), signal.SIGKILL)
        return chosen


class RemoveContainers(Fault):
    """``docker rm -f``, by somebody else."""

    def hold(self) -> float:
        return 1.0

    def begin(self) -> list[str]:
        runs = self.watcher.runs.get("containers", {})
        chosen = self.random.sample(sorted(runs), min(2, len(runs)))
        assert self.cluster.site is not None
        self.cluster.site.docker("rm", "-f", *(container for instance in chosen for container in runs[instance]))
        return chosen


class EngineHangs(Fault):
    def hold(self) -> float:
        return self.random.uniform(3, 10)

    def begin(self) -> list[str]:
        assert self.cluster.engine is not None
        self.cluster.engine.signal(signal.SIGSTOP)
        return []

    def heal(self) -> None:
        assert self.cluster.engine is not None
        self.cluster.engine.signal(signal.SIGCONT)


class EngineKilled(Fault):
    """Containers live on, and the engine finds them again."""

    def begin(self) -> list[str]:
        assert self.cluster.engine is not None
        self.cluster.engine.kill()
        return []

    def heal(self) -> None:
        assert self.cluster.engine is not None
        self.cluster.engine.start("--live-restore")


class SiteCut(Fault):
    """The way between the orchestrators and the engine is cut."""

    def hold(self) -> float:
        return self.random.uniform(3, 10)

    def begin(self) -> list[str]:
        assert self.cluster.proxy is not None
        self.cluster.proxy.cut()
        return []

    def heal(self) -> None:
        assert self.cluster.proxy is not None
        self.cluster.proxy.start()


class LeaderSiteCut(_OfOne):
    """The way between the leader alone and the engine is cut: connections are refused, or get no answer."""

    def __init__(self, cluster: Cluster, watcher: Watcher, rng: random.Random) -> None:
        super().__init__(cluster, watcher, rng, leads=True)

    def hold(self) -> float:
        return self.random.uniform(3, 15)

    def break_it(self) -> None:
        assert self.cluster.proxy is not None
        victim = self.victim
        self.cluster.proxy.shut_out(lambda program: program == victim.pid, silently=self.random.random() < 0.5)

    def heal(self) -> None:
        assert self.cluster.proxy is not None
        self.cluster.proxy.let_in()


class DiskFull(Fault):
    """The disk of one site of processes."""

    def hold(self) -> float:
        return self.random.uniform(3, 8)

    def begin(self) -> list[str]:
        with (self.cluster.small_disk / "filler").open("wb", buffering=0) as file, contextlib.suppress(OSError):
            while file.write(b"x" * 4096):
                pass
        return []

    def heal(self) -> None:
        (self.cluster.small_disk / "filler").unlink(missing_ok=True)


Make = Callable[[Cluster, Watcher, random.Random], Fault]
FAULTS: dict[str, Make] = {
    "kill-leader": lambda *a: Kill(*a, leads=True),
    "kill-follower": lambda *a: Kill(*a, leads=False),
    "pause-leader": lambda *a: Pause(*a, leads=True),
    "pause-follower": lambda *a: Pause(*a, leads=False),
    "end-leadership": lambda *a: Connections(*a, whole=False),
    "end-connections": lambda *a: Connections(*a, whole=True),
    "cut-leader": lambda *a: Partition(*a, leads=True),
    "cut-follower": lambda *a: Partition(*a, leads=False),
    "lossy-leader": lambda *a: Partition(*a, leads=True, percent=33),
    "clock-leader": lambda *a: Clock(*a, leads=True),
    "clock-follower": lambda *a: Clock(*a, leads=False),
    "rolling-restart": Restart,
    "update": Update,
    "database-restart": lambda *a: Database(*a, longest=0.3),
    "database-away": lambda *a: Database(*a, longest=12),
    "database-hangs": DatabaseHangs,
    "kill-services": KillServices,
    "disk-full": DiskFull,
    "remove-containers": RemoveContainers,
    "engine-hangs": EngineHangs,
    "engine-killed": EngineKilled,
    "site-cut": SiteCut,
    "leader-site-cut": LeaderSiteCut,
}
_OF_SERVER = {"database-restart", "database-away", "database-hangs", "update"}
OF_ENGINE = {"remove-containers", "engine-hangs", "engine-killed", "site-cut", "leader-site-cut"}
"""Those that need a Docker engine."""


def fit(one: str, other: str) -> bool:
    """Whether two can be had at a time: not what cannot be done twice to the same thing."""
    return one != other and not any({one, other} <= group for group in (_OF_SERVER, OF_ENGINE))


class Nemesis:
    """One fault after the other, or two at a time; between them all is well for some seconds."""

    def __init__(self, cluster: Cluster, watcher: Watcher, history: History, seed: int) -> None:
        self._cluster, self._watcher, self._history = cluster, watcher, history
        self._random = random.Random(f"{seed} nemesis")

    def plan(self, names: Sequence[str], pairs: bool) -> Iterable[tuple[str, ...]]:
        """Without end: all of them in an order of its own, again and again."""
        while True:
            order = self._random.sample(names, len(names))
            for name in order:
                others = [other for other in names if fit(name, other)]
                yield (name, self._random.choice(others)) if pairs and others else (name,)

    def strike(self, *names: str) -> None:
        """Break these, hold, mend, and wait until all is well; from a thread in the hub."""
        told = " + ".join(names)
        faults = [FAULTS[name](self._cluster, self._watcher, self._random) for name in names]
        self._history.add("fault", fault=told, step="begin")
        for fault in faults:
            hits = fault.begin()
            if hits:
                self._history.add("fault", fault=told, step="hit", hits=hits)
        time.sleep(max(fault.hold() for fault in faults))
        for fault in reversed(faults):
            fault.heal()
        self._history.add("fault", fault=told, step="heal")
        well = wait_for(self.well, _PATIENCE)
        time.sleep(_REST_S)
        self._history.add("fault", fault=told, step="over", well=well)

    def well(self) -> bool:
        """What has ended is started again, as a supervisor of services does."""
        for member in self._cluster.members:
            if not member.runs:
                member.spawn()
        return bool(self._watcher.leaders) and all(member.ready() for member in self._cluster.members)
