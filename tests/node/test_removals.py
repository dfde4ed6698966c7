"""A real engine removes files of volumes when nobody runs any more who may have a folder of them."""

from __future__ import annotations

import asyncio
import contextlib
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

pytestmark = [pytest.mark.docker, pytest.mark.slow]

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
        owned = {"Labels": self.labels}
        mounts = [{"Type": "volume", "Target": "/own", "VolumeOptions": owned}] + [
            {"Type": "volume", "Source": one, "Target": f"/{one}", "VolumeOptions": {**owned, "NoCopy": True}}
            for one in shared
        ]
        body = {
            "Image": "debian:bookworm-slim",
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
        container = str(json.loads(made.content)["Id"])
        if starts:
            started = self.ask(f"POST /containers/{container}/start")
            assert (started.status, started.content) == (HTTPStatus.NO_CONTENT, b"")
        found = json.loads(self.ask(f"GET /containers/{container}/json").content)
        (own,) = (str(one["Name"]) for one in found["Mounts"] if one["Destination"] == "/own")
        return container, own

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
def gated(docker_engine: str) -> Iterator[Gated]:
    with tempfile.TemporaryDirectory(prefix="sky-") as folder:
        path, name = str(Path(folder) / "gate.sock"), f"skytether-kin-{secrets.token_hex(4)}"
        with gate_at(path):
            made = Gated(path, name)
            try:
                yield made
            finally:
                made.clear()


def test_files_are_removed_when_nobody_runs_who_may_have_a_folder_of_them(gated: Gated) -> None:
    # It looks back first: what others run at this engine meets nothing that is made here.
    assert gated.ask(f"DELETE /volumes/{secrets.token_hex(32)}").status == HTTPStatus.NOT_FOUND
    gated.network()
    shared = f"{gated.name}-shared"
    assert gated.ask("POST /volumes/create", {"Name": shared, "Labels": gated.labels}).status == HTTPStatus.CREATED
    one, own = gated.make(shared)
    other, others = gated.make(shared)
    alone, apart = gated.make()
    assert gated.ask(f"DELETE /containers/{alone}?v=1&force=1").status == HTTPStatus.NO_CONTENT
    assert not gated.has(apart)
    assert gated.ask(f"DELETE /containers/{one}?v=1&force=1").status == HTTPStatus.NO_CONTENT
    assert ask(ENGINE, f"/containers/{one}/json").status == HTTPStatus.NOT_FOUND
    assert gated.has(own)
    refused = gated.ask(f"DELETE /volumes/{own}")
    assert (refused.status, b"volume is in use" in refused.content) == (HTTPStatus.CONFLICT, True)
    assert gated.has(own)
    assert gated.ask(f"POST /containers/{other}/kill?signal=KILL").status == HTTPStatus.NO_CONTENT
    assert gated.ask(f"POST /containers/{other}/wait").status == HTTPStatus.OK
    assert gated.ask(f"DELETE /volumes/{own}").status == HTTPStatus.NO_CONTENT
    assert not gated.has(own)
    assert gated.ask(f"DELETE /containers/{other}?v=1").status == HTTPStatus.NO_CONTENT
    assert not gated.has(others)


def test_whose_network_another_one_joins_goes_on_after_that(gated: Gated) -> None:
    """It is paused meanwhile."""
    gated.network()
    holds, _ = gated.make()
    joins, _ = gated.make(network=f"container:{holds}")
    states = [json.loads(gated.ask(f"GET /containers/{one}/json").content)["State"] for one in (holds, joins)]
    assert [state["Status"] for state in states] == ["running", "running"]
    assert gated.ask(f"POST /containers/{holds}/kill?signal=KILL").status == HTTPStatus.NO_CONTENT
    assert gated.ask(f"DELETE /containers/{joins}?force=1").status == HTTPStatus.NO_CONTENT


def test_who_starts_after_a_restart_of_the_node_by_what_was_asked_before_it_has_kin(gated: Gated) -> None:
    """That start waited at the engine, which said meanwhile that nothing runs; files of the machine were removed."""
    gated.network()
    late, own = gated.make(starts=False)
    with tempfile.TemporaryDirectory(prefix="sky-") as folder, gate_at(str(Path(folder) / "gate.sock")):
        again = Gated(str(Path(folder) / "gate.sock"), gated.name)
        assert again.ask(f"DELETE /volumes/{secrets.token_hex(32)}").status == HTTPStatus.NOT_FOUND  # it looks back
        assert ask(ENGINE, f"/v1.41/containers/{late}/start", method="POST").status == HTTPStatus.NO_CONTENT
        holds, _ = again.make(network=f"container:{late}")
        assert again.ask(f"DELETE /containers/{late}?v=1&force=1").status == HTTPStatus.NO_CONTENT
        assert again.ask(f"DELETE /volumes/{own}").status == HTTPStatus.CONFLICT
        assert again.has(own)
        assert again.ask(f"DELETE /containers/{holds}?force=1").status == HTTPStatus.NO_CONTENT
        assert again.ask(f"DELETE /volumes/{own}").status == HTTPStatus.NO_CONTENT
