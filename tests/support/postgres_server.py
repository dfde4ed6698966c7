"""A PostgreSQL server of a test's own, which it may stop, kill and start again."""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
import socket
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import psutil

from skytether.lab.netns import Namespace


@dataclass(frozen=True)
class PostgresServer:
    """On loopback; or at all addresses of a namespace, where everybody may use it; or also at another ``address`` of
    this machine, with the password ``password``."""

    folder: Path
    port: int
    where: Namespace | None = None
    address: str = ""
    password: str = field(default_factory=lambda: secrets.token_hex(16))

    @property
    def url(self) -> str:
        return self.url_at("127.0.0.1")

    @property
    def url_from_outside(self) -> str:
        return f"postgresql://skytether:{self.password}@{self.address}:{self.port}/postgres"

    def url_at(self, host: str, database: str = "postgres") -> str:
        return f"postgresql://skytether@{host}:{self.port}/{database}"

    def control(self, *arguments: str) -> None:
        """``pg_ctl``, as the user that the server runs as."""
        program = max(Path("/usr/lib/postgresql").glob("*/bin/pg_ctl"))
        where = ["-D", str(self.folder / "data"), "-l", str(self.folder / "log")]
        command = [*as_postgres(), str(program), *where, "-s", "-w", *arguments]

        def run() -> None:
            subprocess.run(command, check=True, cwd="/", stdout=subprocess.DEVNULL)

        if self.where is None:
            run()
        else:
            self.where.run(run)

    def start(self) -> None:
        addresses = ",".join(filter(None, ("127.0.0.1", self.address))) if self.where is None else "*"
        self.control("-o", f"-p {self.port} -c listen_addresses={addresses} -c unix_socket_directories=", "start")

    def stop(self, mode: str = "immediate") -> None:
        self.control("-m", mode, "stop")

    def signal(self, number: int) -> None:
        """To all of its processes."""
        server = psutil.Process(int((self.folder / "data/postmaster.pid").read_text().split()[0]))
        for process in (server, *server.children()):
            with contextlib.suppress(psutil.NoSuchProcess):  # some end by themselves, an autovacuum worker for one
                process.send_signal(number)


def as_postgres() -> list[str]:
    """The server refuses to run as root."""
    return ["setpriv", "--reuid=postgres", "--regid=postgres", "--clear-groups"] if os.geteuid() == 0 else []


@contextmanager
def own_server(where: Namespace | None = None, address: str = "") -> Iterator[PostgresServer]:
    """One that runs; nothing is left of it. Its programs must be installed: see ``postgres_programs``."""
    folder = Path(tempfile.mkdtemp(prefix="skytether-pg-"))
    if os.geteuid() == 0:
        shutil.chown(folder, "postgres", "postgres")
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    make = max(Path("/usr/lib/postgresql").glob("*/bin")) / "initdb"
    command = [str(make), "-D", str(folder / "data"), "-U", "skytether", "-A", "trust", "--no-sync"]
    subprocess.run([*as_postgres(), *command], check=True, cwd="/", stdout=subprocess.DEVNULL)
    if where is not None:
        with (folder / "data/pg_hba.conf").open("a") as rules:
            rules.write("host all all 0.0.0.0/0 trust\n")
    server = PostgresServer(folder, port, where, address)
    if address:
        with (folder / "data/pg_hba.conf").open("a") as rules:
            rules.write("host all all 0.0.0.0/0 scram-sha-256\n")
    server.start()
    try:
        if address:
            import psycopg

            with psycopg.connect(server.url, autocommit=True) as connection:
                connection.execute(f"ALTER USER skytether PASSWORD '{server.password}'")
        yield server
    finally:
        server.stop()
        shutil.rmtree(folder)
