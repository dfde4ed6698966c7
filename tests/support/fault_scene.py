"""A real orchestrator with one instance in each phase, to which something is done."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from orchestrator_program import Program, until

from skytether.api.client import Client
from skytether.api.manifest import Manifest
from skytether.api.rest import InstanceCreate, State
from skytether.orchestrator.domain.records import Change
from skytether.orchestrator.store.store import Store

GRACE = 3.0
"""Seconds that an instance gets to end."""


def program_in(folder: Path, **settings: Any) -> Program:
    """Its settings in a file, as an operator has them; ``timing_...`` are those of the group."""
    folder.mkdir(parents=True)
    timing = {"stop_grace": GRACE, "start_timeout": 600}
    timing |= {key.removeprefix("timing_"): value for key, value in settings.items() if key.startswith("timing_")}
    lines = [f"{key}: {value}" for key, value in settings.items() if not key.startswith("timing_")]
    lines += ["timing:", *(f"  {key}: {value}" for key, value in timing.items())]
    (folder / "config.yaml").write_text("\n".join(lines) + "\n")
    return Program(folder / "state", "--config", str(folder / "config.yaml"))


def programs_in(folder: Path) -> Iterator[Callable[..., Program]]:
    """For a fixture: makes programs, each in a folder of its own and without the site `local`, and ends them."""
    made: list[Program] = []

    def make(name: str = "one", **settings: Any) -> Program:
        made.append(program_in(folder / name, local_site="false", **settings))
        return made[-1]

    yield make
    for program in made:
        program.clean_up()


def put_toy(client: Client, name: str = "toy", *, standby: int = 0, tier: str = "edge", **spec: Any) -> None:
    """A service that takes one processor."""
    params = {"additionalProperties": True}
    needs = {"cpu": 1, "memory_mb": 16, "standby": standby, "tiers": [tier]}
    document = {"apiVersion": "skytether.io/v1", "kind": "Service", "metadata": {"name": name}}
    manifest = Manifest.model_validate({**document, "spec": {**spec, "params": params, "needs": needs}})
    client.put_service(name, manifest.model_dump(mode="json", by_alias=True))


def ask(client: Client, robot: str, service: str = "toy", **params: Any) -> str:
    return client.create_instance(InstanceCreate(robot=robot, service=service, lease_s=1000, params=params)).id


@dataclass(frozen=True)
class Scene:
    """One instance in each phase, by its id. The site has room for three."""

    running: str
    starting: str
    stopping: str
    placing: str
    pending: str

    @classmethod
    def begin(cls, client: Client, program: Program) -> Scene:
        """Bring it about. What is to be ``placing`` waits still: that lasts for milliseconds, see ``note_placing``."""
        running = ask(client, "r1")
        starting = ask(client, "r2", never_ready=True)
        stopping = ask(client, "r3", ignore_sigterm=True)
        for instance in (running, stopping):
            until(lambda i=instance: client.get_instance(i).state is State.RUNNING, program)  # type: ignore[misc]
        placing, pending = (ask(client, robot) for robot in ("r4", "r5"))
        until(lambda: client.get_instance(pending).reason, program)
        assert client.get_instance(starting).state is State.STARTING
        client.delete_instance(stopping)
        until(lambda: client.get_instance(stopping).state is State.STOPPING, program)
        return cls(running, starting, stopping, placing, pending)

    def note_placing(self, program: Program) -> None:
        """While no orchestrator runs: leave in the database what one leaves that is killed between two changes."""
        store = Store(f"sqlite:///{program.folder / 'state.db'}")
        record = store.get(self.placing)
        assert record is not None
        assert store.change(Change(record, {"state": State.PLACING, "reason": ""}), time.time())
        store.close()

    def after(self) -> dict[str, State]:
        """What each comes to, if nothing but the orchestrator fails: the end of one makes room for another."""
        return {
            self.running: State.RUNNING,
            self.starting: State.STARTING,
            self.stopping: State.STOPPED,
            self.placing: State.RUNNING,
            self.pending: State.PENDING,
        }
