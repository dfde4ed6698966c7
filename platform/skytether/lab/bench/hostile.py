"""An orchestrator with many robots, one of them hostile: do the others notice?

Everything is real, as in `api`: the orchestrator as a program, each instance a process, requests over HTTP. All robots
renew a lease of a minute every two seconds, from one address, which is the hostile one's too, as behind a router. First
without the hostile one, which is what the machine takes by itself.
"""

from __future__ import annotations

import multiprocessing
import re
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from itertools import cycle
from math import isinf
from pathlib import Path
from statistics import median
from threading import Event, Thread

import numpy as np
import psutil

from skytether.api.client import Client
from skytether.api.rest import InstanceCreate, RobotCreate, SiteCreate
from skytether.lab.embedded import EmbeddedOrchestrator
from skytether.orchestrator.runtimes.disk import size_of

from .api import lost, start
from .hostile_robot import EVIL, EVIL_MANIFEST, Target, attack
from .observe import Spread
from .open_loop import Answered, Request, ask_openly
from .pair import BenchError
from .requests import MANIFEST, SERVICE, Held, renewal

_EVERY_S = 2.0
"""Between the renewals of a robot."""
_LEASE_S = 60.0
_QUIET_S = 20.0
"""For how long nobody is hostile at first, at most."""
_LOOK_S = 1.0
"""Between looks at the memory."""
_MOST_STATE = 1 << 40
"""Bytes of a state folder that are looked at."""
_SEED = 21
_BUCKET = re.compile(r'^skytether_renewal_seconds_bucket\{le="([^"]+)"\} (\S+)$', re.MULTILINE)
_END_S = 60.0


@dataclass(frozen=True, slots=True)
class HostileRow:
    """What the others had of it.

    Attributes:
        minutes: Of attack.
        robots: The hostile one included.
        renewals: Of the others, meanwhile.
        renew_p50_ms: Their median time, from when it was due until all of the answer was read.
        renew_p99_ms: 99th percentile.
        renew_max_ms: The slowest.
        quarters_p99_ms: 99th percentile in each quarter of the time: whether it grows.
        served_p99_ms: 99th percentile of what the orchestrator itself says of them (``skytether_renewal_seconds``): the
            rest is the network's and the measuring client's, which shares the processors with it.
        quiet_p99_ms: 99th percentile before the attack.
        failed: Of the others' renewals, those without a good answer.
        ended_wrongly: Others' instances that do not run any more, or run twice.
        memory_mb: The orchestrator's, at the end.
        memory_growth_mb: Between the median of the second quarter and that of the last; resident memory.
        state_growth_mb: What was written into its state folder, from the attack's begin to its end.
        attacks: Requests and connections of the hostile robot.
        refused: Of these, those that were refused or closed without an answer.
        answers: The same by what was tried and how it was answered; 0: not at all.
    """

    minutes: float
    robots: int
    renewals: int
    renew_p50_ms: float
    renew_p99_ms: float
    renew_max_ms: float
    quarters_p99_ms: tuple[float, ...]
    served_p99_ms: float
    quiet_p99_ms: float
    failed: int
    ended_wrongly: int
    memory_mb: float
    memory_growth_mb: float
    state_growth_mb: float
    attacks: int
    refused: int
    answers: dict[str, dict[int, int]]

    def document(self) -> dict[str, object]:
        """For ``--json``."""
        return asdict(self)


def bench_hostile(
    robots: int, minutes: float, on_progress: Callable[[str], None] = lambda _: None, lease_s: float = _LEASE_S
) -> HostileRow:
    """Let one of the robots do its worst, and look after the others.

    Args:
        robots: At least two.
        minutes: Of attack.
        on_progress: Told what is done.
        lease_s: Of the others' instances [s]; long enough for all of them to start.

    Raises:
        BenchError: Not all instances ran in time, or nothing is known of the attack.
    """
    rng = np.random.default_rng(_SEED)
    with (
        EmbeddedOrchestrator() as orchestrator,
        Client(orchestrator.url, orchestrator.operator_token, timeout=60) as operator,
    ):
        operator.put_service(SERVICE, MANIFEST)
        operator.put_service(EVIL, EVIL_MANIFEST)
        operator.create_site(SiteCreate(name="fleet", tier="edge", runtime="process", options={"cpu": 4 * robots}))
        operator.delete_site("local")
        tokens = [operator.create_robot(RobotCreate(name=f"robot-{i}")).token for i in range(robots - 1)]
        hostile = operator.create_robot(RobotCreate(name="hostile")).token
        held = start(operator, tokens, on_progress, lease_s)
        with Client(orchestrator.url, hostile) as client:
            own = client.create_instance(InstanceCreate(robot="hostile", service=SERVICE, lease_s=3600)).id
            client.wait_running(own)

        def renew(seconds: float) -> list[Answered]:
            return ask_openly(orchestrator.url, _renewals(held), len(held) / _EVERY_S, seconds, rng)

        on_progress("nobody is hostile yet")
        quiet = renew(min(_QUIET_S, 60 * minutes))
        on_progress(f"attack for {minutes:g} min")
        written = _size(orchestrator.state_dir)
        target = Target(orchestrator.url, hostile, "hostile", own, "robot-0", held[0].instance)
        before = _served(operator)
        with _watched(orchestrator.pid) as memory, _attacked(target) as answers:
            under_attack = renew(60 * minutes)
            ended = lost(operator, [one.instance for one in held])
        served = _served(operator)
        served.subtract(before)
        grown = _size(orchestrator.state_dir) - written
    spread = Spread.of([one.seconds for one in under_attack])
    by_kind: dict[str, dict[int, int]] = {}
    for (kind, status), n in sorted(answers.items()):
        by_kind.setdefault(kind, {})[status] = n
    return HostileRow(
        minutes=minutes,
        robots=robots,
        renewals=len(under_attack),
        renew_p50_ms=spread.p50_ms,
        renew_p99_ms=spread.p99_ms,
        renew_max_ms=spread.max_ms,
        quarters_p99_ms=tuple(
            Spread.of(part.tolist()).p99_ms for part in np.array_split([o.seconds for o in under_attack], 4)
        ),
        served_p99_ms=round(1e3 * quantile(served, 0.99), 1),
        quiet_p99_ms=Spread.of([one.seconds for one in quiet]).p99_ms,
        failed=sum(not one.good for one in under_attack),
        ended_wrongly=ended,
        memory_mb=round(memory[-1], 1),
        memory_growth_mb=round(growth(memory), 1),
        state_growth_mb=round(grown / 2**20, 2),
        attacks=sum(answers.values()),
        refused=sum(n for (_, status), n in answers.items() if not 200 <= status < 300),
        answers=by_kind,
    )


def growth(samples: list[float]) -> float:
    """From the second quarter to the last, by their medians: what comes up at first is no leak."""
    quarter = max(1, len(samples) // 4)
    return median(samples[-quarter:]) - median(samples[quarter : 2 * quarter] or samples)


def quantile(counts: Counter[float], share: float) -> float:
    """Of a histogram, as Prometheus reckons it: ``counts`` of values up to each bound, all those below included."""
    wanted, below, before = share * max(counts.values()), 0.0, 0.0
    for bound in sorted(counts):
        if counts[bound] >= wanted:
            inside = counts[bound] - before
            return below if isinf(bound) else below + (bound - below) * (wanted - before) / inside
        below, before = bound, counts[bound]
    return below


def _served(operator: Client) -> Counter[float]:
    """How many renewals were answered within so many seconds, for each bound that the orchestrator counts by."""
    return Counter({float(le): int(float(n)) for le, n in _BUCKET.findall(operator.metrics())})


def _renewals(held: list[Held]) -> Callable[[], Request]:
    turns = cycle(held)
    return lambda: renewal(next(turns))


@contextmanager
def _attacked(target: Target) -> Iterator[Counter[tuple[str, int]]]:
    """While it lasts the robot is hostile; afterwards its answers are there."""
    answers: Counter[tuple[str, int]] = Counter()
    context = multiprocessing.get_context("spawn")
    pipe, end = context.Pipe()
    process = context.Process(target=attack, args=(end, target), daemon=True)
    process.start()
    end.close()
    try:
        yield answers
        pipe.send(None)
        if not pipe.poll(_END_S):
            raise BenchError("the hostile robot did not say how it was answered")
        answers.update(pipe.recv())
    finally:
        pipe.close()
        process.join(_END_S)


@contextmanager
def _watched(pid: int) -> Iterator[list[float]]:
    """The process's resident memory, again and again [MiB]."""
    process, over = psutil.Process(pid), Event()
    samples = [process.memory_info().rss / 2**20]

    def sample() -> None:
        while not over.wait(_LOOK_S):
            samples.append(process.memory_info().rss / 2**20)

    thread = Thread(target=sample, daemon=True)
    thread.start()
    try:
        yield samples
    finally:
        over.set()
        thread.join()


def _size(folder: Path) -> int:
    """Bytes of all files."""
    return size_of(str(folder), _MOST_STATE) or 0
