from __future__ import annotations

import contextlib
import dataclasses
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cache, partial
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import pytest
import uvicorn
from node_scene import NodeScene, ReachedRuntime, find_runtime
from reconcile_bench import Bench
from sqlalchemy import create_engine
from sqlalchemy.dialects.sqlite.pysqlite import SQLiteDialect_pysqlite

from skytether.api.client import Client
from skytether.api.rest import RobotCreate, SiteCreate
from skytether.node import join as node_join
from skytether.node import run as node_run
from skytether.orchestrator.config.settings import Nodes, Settings, Timing
from skytether.orchestrator.core import Orchestrator
from skytether.orchestrator.domain.records import Record
from skytether.orchestrator.http import app
from skytether.orchestrator.http.app import create_app
from skytether.orchestrator.http.refusal_delay import RefusalDelay
from skytether.orchestrator.http.server import listening
from skytether.orchestrator.scheduling import catalog as catalog
from skytether.orchestrator.scheduling import runtime_entry_points
from skytether.orchestrator.scheduling.runtime_entry_points import load_runtime
from skytether.orchestrator.store import engine
from skytether.orchestrator.store.store import Store
from skytether.testing import runtimes
from skytether.testing.runtimes import FakeRuntime

QUICK = Timing(observe=0.02, observe_changing=0.005, place=0.05, stop_grace=0.1, backoff=0.01, backoff_max=0.02)


class Clock:
    """Made-up wall clock, and beside it one that nobody can set."""

    def __init__(self, now: float = 1_700_000_000.0) -> None:
        self.now = now
        self._set_by = 0.0

    def __call__(self) -> float:
        return self.now

    def forward(self, seconds: float) -> None:
        """Time goes by."""
        self.now += seconds

    def set_by(self, seconds: float) -> None:
        """Somebody sets it; no time goes by."""
        self.now += seconds
        self._set_by += seconds

    def steady(self) -> float:
        return self.now - self._set_by


@pytest.fixture
def clock() -> Clock:
    return Clock()


def document(name: str = "toy", **spec: Any) -> dict[str, Any]:
    """A manifest as one writes it."""
    spec = {"entrypoint": "skytether.testing.toy_service", **spec}
    return {"apiVersion": "skytether.io/v1", "kind": "Service", "metadata": {"name": name}, "spec": spec}


@pytest.fixture
def manifest() -> Callable[..., dict[str, Any]]:
    return document


@pytest.fixture
def new_record(clock: Clock) -> Callable[..., Record]:
    def make(name: str = "i1", **changes: Any) -> Record:
        now = clock()
        base = Record(
            id=name,
            robot="walker",
            service="toy",
            session_id=name.rjust(16, "0"),
            manifest=document(needs={"cpu": 1}),
            created_at=now,
            updated_at=now,
            lease_s=15,
            lease_expires_at=now + 15,
        )
        return dataclasses.replace(base, **changes)

    return make


@cache
def migrated() -> bytes:
    """A database of the newest schema: to make one takes far longer than most tests do with it."""
    with tempfile.TemporaryDirectory() as folder:
        store = Store(f"sqlite:///{folder}/state.db")
        store.migrate()
        store.close()
        return (Path(folder) / "state.db").read_bytes()


@pytest.fixture(scope="session", autouse=True)
def installed_services_are_read_once() -> Iterator[None]:
    """They stay what they are while the tests run, and hundreds of orchestrators want to know."""
    read, installed = cache(catalog.read_builtin), cache(entry_points)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(catalog, "entry_points", installed)
        patch.setattr(runtime_entry_points, "entry_points", installed)
        patch.setattr(catalog, "read_builtin", lambda points: read(tuple(points)))
        yield


@pytest.fixture(scope="session", autouse=True)
def refusals_are_not_waited_for() -> Iterator[None]:
    """Hundreds of tests ask what they may not; those of `RefusalDelay` have their own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(app, "RefusalDelay", partial(RefusalDelay, 0.0))
        yield


@pytest.fixture(scope="session", autouse=True)
def statements_are_compiled_once() -> Iterator[None]:
    """Each engine would compile each anew, which takes as long as to execute it a few times."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SQLiteDialect_pysqlite, "__eq__", lambda one, other: type(one) is type(other))
        patch.setattr(SQLiteDialect_pysqlite, "__hash__", lambda one: hash(type(one)))
        patch.setattr(engine, "create_engine", partial(create_engine, execution_options={"compiled_cache": {}}))
        yield


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    (tmp_path / "state.db").write_bytes(migrated())
    store = Store(f"sqlite:///{tmp_path}/state.db")
    yield store
    store.close()


@pytest.fixture
def bench(tmp_path: Path, store: Store, clock: Any) -> Callable[..., Bench]:
    def make(kind: type[FakeRuntime] = FakeRuntime, **options: Any) -> Bench:
        bench = Bench(tmp_path, store, clock, kind, **options)
        bench.reconciler.site_step(bench.site)
        return bench

    return make


@dataclass
class Fleet:
    """Finds fake runtimes by name (``fake``, ``slow``, ...), and remembers those that were made, by site."""

    made: dict[str, FakeRuntime] = field(default_factory=dict)

    def __call__(self, name: str) -> type[Any]:
        kind: Any = getattr(runtimes, f"{name.capitalize()}Runtime", None)
        if kind is None or not name:
            return load_runtime(name)
        fleet = self

        class Remembered(kind):
            def __init__(self, site: str, *rest: Any) -> None:
                super().__init__(site, *rest)
                fleet.made[site] = self

        return Remembered


@dataclass
class Served:
    """An orchestrator behind a real server on loopback, with fakes for runtimes."""

    core: Orchestrator
    url: str
    fleet: Fleet
    token: str
    clients: list[Client] = field(default_factory=list)

    def client(self, token: str | None) -> Client:
        client = Client(self.url, token)
        self.clients.append(client)
        return client

    @property
    def operator(self) -> Client:
        return self.client(self.token)

    def robot(self, name: str = "walker", services: tuple[str, ...] = ("*",)) -> Client:
        return self.client(self.operator.create_robot(RobotCreate(name=name, services=services)).token)

    def site(self, name: str = "lab", runtime: str = "fake", **options: Any) -> FakeRuntime:
        self.operator.create_site(SiteCreate(name=name, tier="edge", runtime=runtime, options=options))
        return self.fleet.made[name]


class Server:
    """A real server on loopback, in a thread, whose app can be changed: stopping one takes a fifth of a second."""

    def __init__(self) -> None:
        self.app: Any = None
        self.url = ""
        self._routes: Any = None

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        await self.app(scope, receive, send)

    def share_routes(self) -> None:
        """They know no orchestrator, and to make them takes longer than most tests do."""
        self._routes = self.app.router = self._routes or self.app.router

    def run(self) -> Iterator[Server]:
        config = uvicorn.Config(self, interface="asgi3", log_config=None, lifespan="off", timeout_graceful_shutdown=1)
        server = uvicorn.Server(config)
        with listening("127.0.0.1", 0) as listener:
            self.url = f"http://127.0.0.1:{listener.getsockname()[1]}"
            thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
            thread.start()
            yield self
            server.should_exit = True
            thread.join()


def served_in(folder: Path, server: Server, **settings: Any) -> Iterator[Served]:
    fleet = Fleet()
    (folder / "state.db").write_bytes(migrated())
    ours = {"timing": QUICK, "catalog": {"modules": ["skytether.testing.toy_service"]}, **settings}
    core = Orchestrator(Settings(state_dir=folder, **ours), find_runtime=fleet)
    core.start()
    core.sites.delete("local")
    server.app = create_app(core)
    server.share_routes()
    served = Served(core, server.url, fleet, (folder / "operator.token").read_text().strip())
    served.operator.put_service("toy", document(params={"properties": {"mass": {"type": "number", "minimum": 0}}}))
    yield served
    for client in served.clients:
        client.close()
    core.stop()


@pytest.fixture(scope="session")
def server() -> Iterator[Server]:
    yield from Server().run()


@pytest.fixture(scope="session")
def shared_server() -> Iterator[Server]:
    yield from Server().run()


@pytest.fixture
def served(tmp_path: Path, server: Server) -> Iterator[Served]:
    yield from served_in(tmp_path, server)


@pytest.fixture
def served_with(tmp_path: Path, server: Server) -> Iterator[Callable[..., Served]]:
    """The same with other settings."""
    with contextlib.ExitStack() as stack:
        yield lambda **settings: stack.enter_context(contextlib.contextmanager(served_in)(tmp_path, server, **settings))


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory, shared_server: Server) -> Iterator[Served]:
    """One for tests that leave it as they found it."""
    yield from served_in(tmp_path_factory.mktemp("shared"), shared_server)


class Later:
    """The time, or what it will be."""

    def __init__(self) -> None:
        self.by = 0.0

    def __call__(self) -> float:
        return time.time() + self.by


@pytest.fixture
def later() -> Later:
    return Later()


@pytest.fixture
def nodes(tmp_path: Path, server: Server, later: Later, monkeypatch: pytest.MonkeyPatch) -> Iterator[NodeScene]:
    """An orchestrator that machines join, and its machines, which wait a tenth of what they would."""
    monkeypatch.setattr(node_join, "POLL_S", 0.02)
    monkeypatch.setattr(node_join, "LEFT_S", 0.1)
    monkeypatch.setattr(node_run, "AGAIN_S", 0.1)
    monkeypatch.setattr(node_run, "LOOK_AWAY_S", 0.1)
    ReachedRuntime.worlds.clear()
    state = tmp_path / "state"
    state.mkdir(mode=0o700)
    (state / "state.db").write_bytes(migrated())
    settings = Settings(
        state_dir=state, timing=QUICK, nodes=Nodes(port=0), catalog={"modules": ["skytether.testing.toy_service"]}
    )
    core = Orchestrator(settings, clock=later, find_runtime=find_runtime)
    core.start()
    core.sites.delete("local")
    server.app = create_app(core)
    server.share_routes()
    with Client(server.url, (state / "operator.token").read_text().strip()) as operator:
        operator.put_service("toy", document(needs={"cpu": 0.1, "memory_mb": 1}))
        scene = NodeScene(core, operator, tmp_path, server.url)
        yield scene
        scene.close()
    core.stop()
