"""A disk without room: a real file system that is full, the real program."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from nothing_lost import assert_nothing_lost, processes, told
from orchestrator_program import Program, alive, until, with_toy

from skytether.api.client import ApiError
from skytether.api.rest import InstanceCreate, State

pytestmark = pytest.mark.slow


@pytest.fixture
def small_disk(tmp_path: Path, netns: None) -> Iterator[Path]:
    """A file system of 4 MiB; what may make network namespaces may mount it."""
    folder = tmp_path / "disk"
    folder.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=4m,mode=0700", "tmpfs", str(folder)], check=True)
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


def test_what_runs_runs_on_and_changes_are_refused_until_there_is_room(small_disk: Path, manifest: Any) -> None:
    program = Program(small_disk / "state")
    try:
        with program.start() as client:
            with_toy(client, manifest)
            made = client.create_instance(InstanceCreate(robot="walker", service="toy", lease_s=1000))
            client.wait_running(made.id)
            pids = program.services()
            filler = small_disk / "filler"
            with filler.open("wb", buffering=0) as file:
                try:
                    while file.write(b"x" * 4096):
                        pass
                except OSError:
                    pass  # full
            refused = None
            for number in range(200):  # what the database had room for already may go well
                try:
                    client.create_instance(InstanceCreate(robot=f"robot-{number}", service="toy", lease_s=1000))
                except ApiError as error:
                    refused = error.problem
                    break
            assert refused is not None
            assert refused.status == 503
            assert client.get_instance(made.id).state is State.RUNNING
            assert all(alive(pid) for pid in pids)
            filler.unlink()
            until(lambda: httpx.get(f"{(program.folder / 'address').read_text().strip()}/readyz").status_code == 200)
            after = client.create_instance(InstanceCreate(robot="later", service="toy", lease_s=1000))
            assert client.wait_running(after.id).state is State.RUNNING
            assert client.get_instance(made.id).restarts == 0
            running = dict.fromkeys((made.id, after.id), State.RUNNING)
            assert_nothing_lost(told(client), running, processes(program.folder))
            for instance in client.instances():
                client.delete_instance(instance.id)
            ended = {i.id: State.STOPPED for i in client.instances()}
            assert_nothing_lost(told(client), ended, processes(program.folder))
    finally:
        program.clean_up()
