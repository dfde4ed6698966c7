"""How far one orchestrator goes: thousands of instances at a Kubernetes site whose API server is made up.

The orchestrator is the real program, with the real client of Kubernetes over real sockets; the cluster is
``cluster_server``, whose pods run a second after they are begun, for no machine at hand has room for ten thousand. At
each number of instances it is measured what they cost, and how long other robots wait for a service, cold and warm.
Last comes a crowd that waits for room, and gets it.
"""

from __future__ import annotations

import itertools
import json
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal
from urllib.request import urlopen

import numpy as np
import psutil

from skytether.api.client import Client
from skytether.api.rest import InstanceCreate, RobotCreate, SiteCreate, State
from skytether.lab.embedded import EmbeddedOrchestrator

from .api import passes_in
from .observe import Spread, cpu_seconds
from .open_loop import ask_openly
from .pair import BenchError
from .requests import Held, renewal, sleeper

_SERVICE, _WARM = "sleeper", "warm-sleeper"
_IMAGE = "registry.invalid/sleeper:1"
_SITE = "fleet"
_LEASE_S = 3600.0
_ASKERS = 4
_ASK_HZ = 4.0
_RENEW_HZ = 100.0
_LIMIT_S = 1200.0
_LOOK_S = 0.25
_RARELY_S = 3.0
_SEED = 16
_LEADS = re.compile(r"^skytether_leader_epoch(?:\{\})? (\S+)$", re.MULTILINE)
_UNBOUNDED = {"QUOTAS_SITE_INSTANCES": "1000000", "QUOTAS_SERVICE_INSTANCES": "1000000", "LOGS_LEVEL": "debug"}


@dataclass(frozen=True, slots=True)
class ScaleRow:
    """What so many instances cost.

    Attributes:
        instances: That run meanwhile.
        started_per_s: How many became ready in a second, while they were asked for as fast as could be.
        pass_ms: The longest pass over the site that looks at all of them [ms].
        pass_us_each: The same for each instance [us].
        placer_ms: The longest pass of the placer [ms].
        placer_us_each: The same for each instance [us].
        cpu: Cores that the orchestrator kept busy with nobody asking.
        memory_mb: Of the orchestrator, resident [MiB].
        calls_per_s: Of the API server, with nobody asking.
        most_calls_per_s: In any second so far.
        renewals_per_s: That robots made for a while, with full reports, at random times.
        renew_p50_ms: Median time until they were answered [ms].
        renew_p99_ms: Its 99th percentile.
        renew_cpu_ms: Of a processor for each, at the orchestrators, with what they do anyway taken away [ms].
        cold_p50_s: From a robot's request until its new instance runs, median [s]; the cluster takes a second of that.
        cold_p99_s: Its 99th percentile.
        warm_p50_s: The same where an instance is kept warm.
        warm_p99_s: Its 99th percentile.
    """

    instances: int
    started_per_s: float
    pass_ms: float
    pass_us_each: float
    placer_ms: float
    placer_us_each: float
    cpu: float
    memory_mb: float
    calls_per_s: float
    most_calls_per_s: int
    renewals_per_s: float
    renew_p50_ms: float
    renew_p99_ms: float
    renew_cpu_ms: float
    cold_p50_s: float
    cold_p99_s: float
    warm_p50_s: float
    warm_p99_s: float


@dataclass(frozen=True, slots=True)
class Scale:
    """The whole measurement.

    Attributes:
        rows: At each number of instances.
        placements: Instances that waited for room at once.
        placements_per_s: How many of them were given a site in a second, from when there was room.
        memory_kb_each: By which the orchestrator grew for each instance, from the first row to the last [KiB].
        refused_calls: That the API server has answered with 429.
    """

    rows: tuple[ScaleRow, ...]
    placements: int
    placements_per_s: float
    memory_kb_each: float
    refused_calls: int

    def document(self) -> dict[str, object]:
        """For ``--json``."""
        return asdict(self)


def bench_scale(
    levels: Sequence[int],
    placements: int,
    calls_per_s: float,
    start_s: float = 1.0,
    on_progress: Callable[[str], None] = lambda _: None,
    *,
    idle_s: float = 12.0,
    asking: int = 40,
    replicas: int = 1,
    database: str | None = None,
) -> Scale:
    """Start instances up to each of the levels, and measure there.

    Args:
        levels: Numbers of instances, growing.
        placements: Of the crowd that waits for room.
        calls_per_s: Beyond so many the API server refuses.
        start_s: What the cluster takes to start one [s].
        on_progress: Told what is done.
        idle_s: For how long nobody asks, at each level [s].
        asking: Robots that then ask at random times, as many again with their service kept warm.
        replicas: Orchestrators, which robots ask in turn.
        database: Address of PostgreSQL, which several need; an empty database. None: SQLite.

    Raises:
        BenchError: Not all instances ran in time.
    """
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="skytether-scale-")))
        address = stack.enter_context(made_up_cluster(start_s, calls_per_s))
        environment = {f"SKYTETHER_{name}": value for name, value in _UNBOUNDED.items()}
        environment["SKYTETHER_SECRETS_DIR"] = str(folder / "secrets")
        if database is not None:
            environment["SKYTETHER_DATABASE_URL"] = database
        orchestrators = [stack.enter_context(EmbeddedOrchestrator(environment=environment)) for _ in range(replicas)]
        token = (folder / "secrets" / "operator.token").read_text().strip()
        clients = [stack.enter_context(Client(one.url, token, timeout=60)) for one in orchestrators]
        kubeconfig = kubeconfig_of(folder, address)
        clients[0].put_service(_SERVICE, _manifest(_SERVICE))
        clients[0].create_site(_site(_SITE, kubeconfig))
        clients[0].delete_site("local")
        bench = _Bench(orchestrators, clients, token, address, idle_s, asking, on_progress)
        rows = [bench.level(n) for n in levels]
        per_s = bench.crowd(placements, kubeconfig)
        refused = calls(address)["refused"]
    grown = rows[-1].memory_mb - rows[0].memory_mb
    more = rows[-1].instances - rows[0].instances
    return Scale(tuple(rows), placements, round(per_s, 1), round(1024 * grown / more, 1) if more else 0.0, int(refused))


class _Bench:
    def __init__(
        self,
        orchestrators: Sequence[EmbeddedOrchestrator],
        clients: Sequence[Client],
        token: str,
        address: str,
        idle_s: float,
        asking: int,
        on_progress: Callable[[str], None],
    ) -> None:
        self._idle_s, self._asking = idle_s, asking
        self._orchestrators, self._clients, self._token, self._address = orchestrators, clients, token, address
        self._on_progress = on_progress
        self._robots = 0
        self._held: list[str] = []
        self._rng = np.random.default_rng(_SEED)

    @cached_property
    def _leads(self) -> int:
        """Which orchestrator leads."""
        if len(self._clients) == 1:
            return 0
        return next(i for i, one in enumerate(self._clients) if float(_LEADS.findall(one.metrics())[0]) > 0)

    @property
    def _operator(self) -> Client:
        return self._clients[self._leads]

    def _cpu(self) -> float:
        return sum(cpu_seconds(one.pid) for one in self._orchestrators)

    def level(self, instances: int) -> ScaleRow:
        """Start what is missing, and measure."""
        asked = self._fill(instances)
        self._on_progress(f"{instances} instances run, nobody asks")
        before = calls(self._address)
        leader = self._orchestrators[self._leads]
        written, busy = len(leader.log), self._cpu()
        time.sleep(self._idle_s)
        cpu = (self._cpu() - busy) / self._idle_s
        after = calls(self._address)
        passes = passes_in(leader.log[written:])
        if not passes.get(f"site-{_SITE}") or not passes.get("placer"):
            raise BenchError("the reconciler made no pass")
        memory = psutil.Process(leader.pid).memory_info().rss / 2**20
        self._on_progress(f"{instances} instances run, robots renew")
        busy = self._cpu()
        renewals = self._renew()
        renew_cpu = self._cpu() - busy - cpu * self._idle_s
        self._on_progress(f"{instances} instances run, some robots ask")
        cold = self._wait_for(_SERVICE)
        warm = self._warm()
        pass_ms, placer_ms = max(passes[f"site-{_SITE}"]), max(passes["placer"])
        return ScaleRow(
            instances=instances,
            started_per_s=round(asked, 1),
            pass_ms=round(pass_ms, 1),
            pass_us_each=round(1e3 * pass_ms / instances, 1),
            placer_ms=round(placer_ms, 1),
            placer_us_each=round(1e3 * placer_ms / instances, 1),
            cpu=round(cpu, 3),
            memory_mb=round(memory, 1),
            calls_per_s=round((_sum(after) - _sum(before)) / self._idle_s, 1),
            most_calls_per_s=max(before["most_in_a_second"], after["most_in_a_second"]),
            renewals_per_s=_RENEW_HZ,
            renew_p50_ms=renewals.p50_ms,
            renew_p99_ms=renewals.p99_ms,
            renew_cpu_ms=round(1e3 * renew_cpu / renewals.n, 2),
            cold_p50_s=round(cold.p50_ms / 1e3, 3),
            cold_p99_s=round(cold.p99_ms / 1e3, 3),
            warm_p50_s=round(warm.p50_ms / 1e3, 3),
            warm_p99_s=round(warm.p99_ms / 1e3, 3),
        )

    def _names(self, count: int) -> list[str]:
        names = [f"robot-{self._robots + i}" for i in range(count)]
        self._robots += count
        return names

    def _renew(self) -> Spread:
        """How long renewals take that come at random times, from all robots in turn, asked of who leads."""
        turns = itertools.cycle(self._held)
        url = self._orchestrators[self._leads].url
        asked = ask_openly(url, lambda: renewal(Held("", self._token, next(turns))), _RENEW_HZ, self._idle_s, self._rng)
        if failed := sum(not one.good for one in asked):
            raise BenchError(f"{failed} of {len(asked)} renewals got no good answer")
        return Spread.of([one.seconds for one in asked])

    def _ask(self, names: Sequence[str], service: str = _SERVICE) -> list[str]:
        """Each robot for an instance, as fast as they are answered."""
        turns = itertools.cycle(self._clients)

        def ask(name: str) -> str:
            client = next(turns)
            client.create_robot(RobotCreate(name=name))
            return client.create_instance(_request(name, service)).id

        with ThreadPoolExecutor(_ASKERS) as pool:
            return list(pool.map(ask, names))

    def _fill(self, instances: int) -> float:
        """Instances that became ready in a second."""
        before = self._count(_SERVICE, "starting")
        missing = instances - len(self._held)
        if missing <= 0:
            return 0.0
        began = time.monotonic()
        with ThreadPoolExecutor(1) as pool:
            asking = pool.submit(self._ask, self._names(missing))
            while (up := self._count(_SERVICE, "starting") - before) < missing:
                self._on_progress(f"{len(self._held) + up} of {instances} instances run")
                if time.monotonic() - began > _LIMIT_S:
                    raise BenchError(f"only {up} of {instances} instances ran within {_LIMIT_S:.0f} s")
                time.sleep(_LOOK_S + missing / 2000)
            self._held += asking.result()
        return missing / (time.monotonic() - began)

    def _count(self, service: str, phase: str) -> int:
        """Instances of a service that went through a phase of their start so far, as the metrics say."""
        pattern = rf'^skytether_instance_start_seconds_count\{{phase="{phase}",service="{service}",[^}}]*\}} (\S+)$'
        return int(sum(map(float, re.findall(pattern, self._operator.metrics(), re.MULTILINE))))

    def _wait_for(self, service: str) -> Spread:
        """How long robots wait that come at random times."""
        took: list[float] = []
        names = self._names(self._asking)
        for name in names:
            self._operator.create_robot(RobotCreate(name=name))

        turns = itertools.cycle(self._orchestrators)

        def come(name: str) -> str:
            began = time.monotonic()
            with Client(next(turns).url, self._token, timeout=60) as client:
                made = client.create_instance(_request(name, service))
                if made.state is not State.RUNNING:
                    client.wait_running(made.id, timeout=60)
            took.append(time.monotonic() - began)
            return made.id

        with ThreadPoolExecutor(self._asking) as pool:
            coming = []
            for name in names:
                coming.append(pool.submit(come, name))
                time.sleep(self._rng.exponential(1 / _ASK_HZ))
            made = [one.result() for one in coming]
        for one in made:
            self._operator.delete_instance(one)
        return Spread.of(took)

    def _warm(self) -> Spread:
        """The same, with enough instances kept warm."""
        self._operator.put_service(_WARM, _manifest(_WARM, standby=self._asking))
        deadline = time.monotonic() + _LIMIT_S
        while self._spares() < self._asking:
            if time.monotonic() > deadline:
                raise BenchError("the standbys did not come up")
            time.sleep(1.0)
        spread = self._wait_for(_WARM)
        self._operator.put_service(_WARM, _manifest(_WARM, standby=0))
        while any(one.service == _WARM and not one.state.final for one in self._operator.instances()):
            if time.monotonic() > deadline:
                raise BenchError("the standbys did not end")
            time.sleep(1.0)
        return spread

    def _spares(self) -> int:
        return sum(
            one.service == _WARM and not one.robot and one.state is State.RUNNING for one in self._operator.instances()
        )

    def crowd(self, count: int, kubeconfig: Path) -> float:
        """Instances that are given a site in a second, counted from when room comes for a crowd that waits."""
        self._on_progress(f"{count} robots wait for room")
        self._operator.put_service("crowd", _manifest("crowd", tiers=["cloud"]))
        self._operator.create_site(_site("small", kubeconfig, tier="cloud", cpu=0.001))  # one has room
        made = self._ask(self._names(count), "crowd")
        self._on_progress(f"{count} instances are given a site")
        room = time.time()
        self._operator.create_site(_site("large", kubeconfig, tier="cloud"))
        began = time.monotonic()
        while (placed := self._count("crowd", "placing")) < count:
            if time.monotonic() - began > _LIMIT_S:
                raise BenchError(f"only {placed} of {count} instances were given a site within {_LIMIT_S:.0f} s")
            time.sleep(_RARELY_S)  # each look at the metrics takes a while of the orchestrator, too
        with ThreadPoolExecutor(_ASKERS) as pool:
            times = sorted(pool.map(self._placed_at, made))[1:]  # the first one has filled the small site
        return len(times) / (times[-1] - room)

    def _placed_at(self, instance: str) -> float:
        """Seconds since the epoch."""
        return next(e.at for e in self._operator.watch(instance) if e.state is State.STARTING).timestamp()


def _request(robot: str, service: str) -> InstanceCreate:
    return InstanceCreate(robot=robot, service=service, lease_s=_LEASE_S)


def _manifest(name: str, standby: int = 0, tiers: Sequence[str] = ("edge",)) -> dict[str, Any]:
    manifest = sleeper([])
    manifest["metadata"]["name"] = name
    spec = {**manifest["spec"], "image": _IMAGE}
    spec["needs"] = {**spec["needs"], "tiers": list(tiers), "standby": standby}
    del spec["entrypoint"]
    return {**manifest, "spec": spec}


def _site(name: str, kubeconfig: Path, tier: Literal["edge", "cloud"] = "edge", **options: object) -> SiteCreate:
    told = {"kubeconfig": str(kubeconfig), "reach": "pod", **options}
    return SiteCreate(name=name, tier=tier, runtime="kubernetes", options=told)


def kubeconfig_of(folder: Path, address: str) -> Path:
    """For the made-up API server, which asks nobody who they are."""
    document = {
        "apiVersion": "v1",
        "kind": "Config",
        "clusters": [{"name": "made-up", "cluster": {"server": address}}],
        "users": [{"name": "anybody", "user": {}}],
        "contexts": [{"name": "made-up", "context": {"cluster": "made-up", "user": "anybody"}}],
        "current-context": "made-up",
    }
    path = folder / "kubeconfig"
    path.write_text(json.dumps(document))
    return path


@contextmanager
def made_up_cluster(start_s: float, calls_per_s: float) -> Iterator[str]:
    """Address of a made-up API server."""
    command = [sys.executable, "-P", "-m", "skytether.lab.bench.cluster_server"]
    command += ["--start-s", str(start_s), "--most-per-s", str(calls_per_s)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            port = process.stdout.readline().strip() if process.stdout else ""
            if not port:
                raise BenchError("the made-up API server did not start")
            yield f"http://127.0.0.1:{port}"
        finally:
            process.terminate()


def calls(address: str) -> dict[str, Any]:
    """What a made-up API server was asked: ``calls`` by kind, ``most_in_a_second`` since the last look, ``refused``."""
    with urlopen(f"{address}/calls", timeout=10) as answer:  # noqa: S310 (ours, on loopback)
        told: dict[str, Any] = json.load(answer)
    return told


def _sum(told: dict[str, Any]) -> int:
    return sum(told["calls"].values())
