"""Several orchestrators over one PostgreSQL, each in a network of its own, so that the ways between can be cut.

The server is in a network, the hub, to which each orchestrator has a cable; so are all threads that ask them. Sites:
two of processes, the second of them on a small disk; and containers, where there is an engine of the run's own.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import httpx
import psycopg
from docker_site import DockerSite, Images
from engine_ways import EngineProxy
from networks import cable, nft
from nothing_lost import processes
from orchestrator_program import PATIENCE, Program, until
from own_engine import OwnEngine
from postgres_server import PostgresServer, own_server

from skytether.api.client import Client
from skytether.api.rest import SiteCreate
from skytether.lab.netns import Namespace, enter

PORT = 8600
DATABASE = "skytether"
TOY, WARM, BOXED = "toy", "warm", "boxed"
"""Services: two that run as processes, one that runs in a container."""
STANDBYS = {WARM: 2, BOXED: 1}
"""How many instances of each are kept for nobody."""
_CONFIG = """\
local_site: false
insecure_http: true
limits: {ended_count: 1000000, events: 1000000}
quotas: {robot_instances: 100, streams: 4096}
timing: {stop_grace: 3}
"""


class Member(Program):
    """One orchestrator."""

    def __init__(self, number: int, folder: Path, server: PostgresServer, faketime: str | None) -> None:
        self.number = number
        self.host, self._hub_host = f"10.77.{number}.2", f"10.77.{number}.1"
        self.place = Namespace()
        assert server.where is not None
        cable(server.where, self.place, (f"to{number}", f"{self._hub_host}/24"), ("eth0", f"{self.host}/24"))
        self._database_port = server.port
        (folder / str(number)).mkdir()
        config = folder / str(number) / "config.yaml"
        config.write_text(_CONFIG)
        options = ("--config", str(config), "--secrets-dir", str(folder / "secrets"), "--host", self.host)
        database = ("--database", server.url_at(self._hub_host, DATABASE))
        super().__init__(folder / str(number) / "state", *options, *database, "--port", str(PORT))
        self._offset = folder / str(number) / "offset"
        self.set_clock(0)
        if faketime:
            self.environment = {
                "LD_PRELOAD": faketime,
                "FAKETIME_TIMESTAMP_FILE": str(self._offset),
                "FAKETIME_CACHE_DURATION": "1",  # seconds; without a cache each look at the clock reads the file
                "FAKETIME_DONT_FAKE_MONOTONIC": "1",
                "PYTHONPATH": str(Path(__file__).parent / "faked"),
            }
        self.paused = self._cut = False

    @property
    def url(self) -> str:
        return f"http://{self.host}:{PORT}"

    def spawn(self) -> subprocess.Popen[bytes]:
        (self.folder / "address").unlink(missing_ok=True)
        self.paused = False
        return self.place.run(super().spawn)

    @property
    def runs(self) -> bool:
        return self.process is not None and self.process.poll() is None

    @property
    def pid(self) -> int | None:
        return self.process.pid if self.process is not None else None

    @property
    def acts(self) -> bool:
        """Whether it could do anything at all."""
        return self.runs and not self.paused and not self._cut

    def pause(self) -> None:
        if self.process is not None and self.runs:
            self.process.send_signal(signal.SIGSTOP)
            self.paused = True

    def go_on(self) -> None:
        if self.process is not None and self.runs:
            self.process.send_signal(signal.SIGCONT)
        self.paused = False

    def set_clock(self, seconds: float) -> None:
        """Against the right time; it is taken within a second."""
        draft = self._offset.with_suffix(".new")
        draft.write_text(f"{seconds:+.0f}")
        draft.replace(self._offset)

    def lose(self, percent: int) -> None:
        """So much of what goes between it and the database, both ways; 0: nothing."""
        often = "" if percent >= 100 else f"numgen random mod 100 < {percent} "
        chains = "".join(
            f"chain {hook} {{ type filter hook {hook} priority 0; tcp {end} {self._database_port} {often}drop; }}\n"
            for hook, end in (("output", "dport"), ("input", "sport"))
        )
        self._cut = percent >= 100
        nft(self.place, "flush ruleset\n" + (f"table ip lossy {{\n{chains}}}\n" if percent else ""))

    def ready(self) -> bool:
        """For a thread in the hub."""
        with contextlib.suppress(httpx.HTTPError):
            return httpx.get(f"{self.url}/readyz", timeout=2, trust_env=False).status_code == 200
        return False


class Cluster:
    """All that is under test. Ask from threads that ``thread`` or ``inside`` started."""

    def __init__(self, folder: Path, members: list[Member], server: PostgresServer) -> None:
        self.folder, self.members, self.server = folder, members, server
        assert server.where is not None
        self._hub = server.where
        self.instances = folder / "sites"
        self.small_disk = self.instances / "two"
        self.site: DockerSite | None = None
        self.engine: OwnEngine | None = None
        self.proxy: EngineProxy | None = None
        self.processes = processes(self.instances)
        self.standbys: dict[str, int] = {}
        """How many there are to be, by service."""

    @property
    def token(self) -> str:
        return (self.folder / "secrets/operator.token").read_text().strip()

    def inside(self, call: Callable[[], Any]) -> Any:
        return self._hub.run(call)

    def thread(self, call: Callable[[], object], name: str) -> threading.Thread:
        """One that runs."""

        def run() -> None:
            enter(self._hub.path)
            call()

        thread = threading.Thread(target=run, name=name, daemon=True)
        thread.start()
        return thread

    def client(self, *numbers: int, timeout: float = 2.0) -> Client:
        """One that asks these orchestrators, in this order."""
        urls = ",".join(self.members[number].url for number in numbers)
        return Client(urls, self.token, timeout=timeout, insecure_http=True)

    def connect(self) -> psycopg.Connection[Any]:
        """To the database itself; from within the hub."""
        return psycopg.connect(self.server.url_at("127.0.0.1", DATABASE), autocommit=True, connect_timeout=3)

    def sql(self, query: Any, *values: Any) -> list[tuple[Any, ...]]:
        with self.connect() as connection:
            return connection.execute(query, values).fetchall()

    def containers(self) -> dict[str, list[str]]:
        """The containers that run, by instance; empty where there is no engine."""
        if self.engine is None or self.site is None:
            return {}
        import docker

        with contextlib.closing(docker.DockerClient(base_url=self.engine.address, timeout=3, version="1.41")) as client:
            labels = [f"skytether.io/owner={self.site.owner}", "skytether.io/instance"]
            found: dict[str, list[str]] = {}
            for row in client.api.containers(filters={"label": labels, "status": ["running", "paused"]}):
                found.setdefault(row["Labels"]["skytether.io/instance"], []).append(row["Id"])
        return found

    def set_up(self) -> None:
        """Start all; add sites and services."""
        for member in self.members:
            member.spawn()
        for member in self.members:
            until(lambda member=member: self.inside(member.ready), member)  # type: ignore[misc]
        self.inside(self._add_sites)

    def _add_sites(self) -> None:
        with self.client(0, timeout=PATIENCE) as client:
            for name in ("one", "two"):
                options: dict[str, Any] = {"folder": str(self.instances / name), "cpu": 100}
                client.create_site(SiteCreate(name=name, tier="edge", runtime="process", options=options))
            for service in (TOY, WARM):
                client.put_service(service, _manifest(service, STANDBYS.get(service, 0), **_PROCESS))
            if self.site is not None and self.proxy is not None:
                options = self.site.options(engine=self.proxy.engine, cpu=100)
                client.create_site(SiteCreate(name="boxes", tier="edge", runtime="docker", options=options))
                client.put_service(BOXED, _manifest(BOXED, STANDBYS[BOXED], image=self.site.images.toy))
        self.standbys = {service: STANDBYS[service] for service in (WARM, BOXED) if service == WARM or self.site}

    def end_standbys(self) -> None:
        """Nothing is kept for nobody any more: one service needs none, the other one is deleted."""
        with self.client(*range(len(self.members)), timeout=PATIENCE) as client:
            client.put_service(WARM, _manifest(WARM, 0, **_PROCESS))
            if self.site is not None:
                client.delete_service(BOXED)
        self.standbys = {}

    def heal(self) -> None:
        """Undo whatever any fault did."""
        for member in self.members:
            member.lose(0)
            member.set_clock(0)
            member.go_on()
            if not member.runs:
                member.spawn()

    def clean_up(self) -> None:
        for member in self.members:
            member.go_on()
            member.clean_up()
        for sessions in self.processes().values():
            for session in sessions:
                with contextlib.suppress(ProcessLookupError, PermissionError):
                    os.killpg(int(session.split()[1]), signal.SIGKILL)


_PROCESS = {"entrypoint": "skytether.testing.toy_service"}


def _manifest(name: str, standby: int, **spec: Any) -> dict[str, Any]:
    needs = {"cpu": 0.01, "memory_mb": 64, "standby": standby}
    params = {"additionalProperties": True, "required": ["say"]}  # no standby is made before somebody has asked
    spec = {**spec, "params": params, "needs": needs}
    return {"apiVersion": "skytether.io/v1", "kind": "Service", "metadata": {"name": name}, "spec": spec}


@contextmanager
def cluster(folder: Path, faketime: str | None, images: Images | None, count: int = 3) -> Iterator[Cluster]:
    """Several orchestrators that answer; nothing is left of them but their logs, in ``folder``."""
    with ExitStack() as stack:
        hub = stack.enter_context(Namespace())
        server = stack.enter_context(own_server(hub))
        hub.run(lambda: _make_database(server))
        (folder / "secrets").mkdir(mode=0o700)
        made = Cluster(folder, [Member(number, folder, server, faketime) for number in range(count)], server)
        for member in made.members:
            stack.callback(member.place.close)
        made.small_disk.mkdir(parents=True)
        # What an hour's instances leave there for a day, with their logs, fits in; in 8 MiB it did not.
        subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64m,mode=0700", "tmpfs", str(made.small_disk)], check=True)
        stack.callback(subprocess.run, ["umount", "-l", str(made.small_disk)], check=True)
        if images is not None:
            made.engine = stack.enter_context(contextlib.closing(OwnEngine()))
            made.engine.start("--live-restore")
            made.engine.load(images.toy, images.name("guard"))
            made.site = stack.enter_context(contextlib.closing(DockerSite(images, made.engine.address)))
            made.proxy = EngineProxy(folder / "engine.sock", target=made.engine.address)
            made.proxy.start()
            stack.callback(made.proxy.cut)
        stack.callback(made.clean_up)
        made.set_up()
        yield made


def _make_database(server: PostgresServer) -> None:
    with psycopg.connect(server.url, autocommit=True) as connection:
        connection.execute(f"CREATE DATABASE {DATABASE}")  # type: ignore[arg-type]


def wait_for(condition: Callable[[], Any], seconds: float) -> bool:
    """Whether it came to pass."""
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.05)
    return True
