"""An orchestrator at the real engine, behind a node's gate."""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import json
import secrets
import tempfile
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path
from typing import Any

import pytest

from skytether.api.splice import closed, splice
from skytether.node.engine_gate import EngineGate
from skytether.node.machine import Answer, ask

ENGINE = "/var/run/docker.sock"


@dataclass
class Gated:
    """An orchestrator by a gate, at the real engine."""

    path: str
    name: str
    """What names of all that it makes begin with."""

    def ask(self, line: str, body: Any = None) -> Answer:
        method, _, path = line.partition(" ")
        return ask(self.path, f"/v1.41{path}", method=method, body=body, patience=60)

    @property
    def labels(self) -> dict[str, str]:
        return {"skytether.io/owner": self.name}

    def network(self) -> None:
        """One of its own."""
        options = {"com.docker.network.bridge.name": f"skt-{self.name[-8:]}"}
        body = {"Name": self.name, "CheckDuplicate": True, "Driver": "bridge", "Options": options}
        made = self.ask("POST /networks/create", {**body, "Labels": {"skytether.io/network": "filtered"}})
        assert made.status == HTTPStatus.CREATED, made.content

    def make(self, *shared: str, network: str = "", starts: bool = True) -> tuple[str, str]:
        """A container that runs, or is to be started, and the volume that it alone has."""
        container = self.create("debian:bookworm-slim", *shared, network=network)
        if starts:
            started = self.ask(f"POST /containers/{container}/start")
            assert (started.status, started.content) == (HTTPStatus.NO_CONTENT, b"")
        found = json.loads(self.ask(f"GET /containers/{container}/json").content)
        (own,) = (str(one["Name"]) for one in found["Mounts"] if one["Destination"] == "/own")
        return container, own

    def create(self, image: str, *shared: str, network: str = "") -> str:
        """A container that was not started; returns its id."""
        owned = {"Labels": self.labels}
        mounts = [{"Type": "volume", "Target": "/own", "VolumeOptions": owned}] + [
            {"Type": "volume", "Source": one, "Target": f"/{one}", "VolumeOptions": {**owned, "NoCopy": True}}
            for one in shared
        ]
        body = {
            "Image": image,
            "Entrypoint": ["sleep", "600"],
            "Labels": self.labels,
            "HostConfig": {
                "NetworkMode": network or self.name,
                "CapDrop": ["ALL"],
                "SecurityOpt": ["no-new-privileges"],
                "ReadonlyRootfs": True,
                "PidsLimit": 9,
                "Init": True,
                "Mounts": mounts,
            },
        }
        made = self.ask(f"POST /containers/create?name={self.name}-{secrets.token_hex(4)}", body)
        assert made.status == HTTPStatus.CREATED, made.content
        return str(json.loads(made.content)["Id"])

    def has(self, volume: str) -> bool:
        return ask(ENGINE, f"/volumes/{volume}").status == HTTPStatus.OK

    def clear(self) -> None:
        label = json.dumps({"label": [f"skytether.io/owner={self.name}"]}).replace('"', "%22").replace(" ", "")
        for one in json.loads(ask(ENGINE, f"/containers/json?all=1&filters={label}").content):
            ask(ENGINE, f"/containers/{one['Id']}?force=1&v=1", method="DELETE", patience=60)
        for one in json.loads(ask(ENGINE, f"/volumes?filters={label}").content)["Volumes"] or ():
            ask(ENGINE, f"/volumes/{one['Name']}", method="DELETE")
        ask(ENGINE, f"/networks/{self.name}", method="DELETE")


@contextlib.contextmanager
def gate_at(path: str) -> Iterator[None]:
    """A node's gate, by a socket that is no link."""
    over, stands, loop = asyncio.Event(), threading.Event(), asyncio.new_event_loop()

    async def run() -> None:
        gate, ways = EngineGate(ENGINE), set[asyncio.Task[Any]]()

        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            ways.add(asyncio.current_task())  # type: ignore[arg-type]
            there = await asyncio.open_unix_connection(ENGINE)
            try:
                await splice((reader, writer), there, there=gate.of_link())
            finally:
                there[1].transport.abort()
                writer.transport.abort()

        async with await asyncio.start_unix_server(serve, path):
            stands.set()
            await over.wait()
        await asyncio.gather(*ways, return_exceptions=True)
        await closed()

    thread = threading.Thread(target=loop.run_until_complete, args=(run(),))
    thread.start()
    try:
        assert stands.wait(10)
        yield
    finally:
        loop.call_soon_threadsafe(over.set)
        thread.join()
        loop.run_until_complete(loop.shutdown_default_executor())
        loop.close()


@pytest.fixture
def gated(docker_engine: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[Gated]:
    monkeypatch.setattr("skytether.node.removals._QUIET_S", 0.0)  # no program was there before
    with (
        tempfile.TemporaryDirectory(prefix="sky-") as folder,
        (Path(tempfile.gettempdir()) / "sky-gated").open("w") as one,
    ):
        fcntl.flock(one, fcntl.LOCK_EX)  # another gate that begins takes what this one looks at for left behind
        path, name = str(Path(folder) / "gate.sock"), f"skytether-kin-{secrets.token_hex(4)}"
        with gate_at(path):
            made = Gated(path, name)
            try:
                yield made
            finally:
                made.clear()
