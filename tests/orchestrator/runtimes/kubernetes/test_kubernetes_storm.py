"""Robots come, move and go; orchestrators are killed and frozen, and the API server of their cluster misbehaves."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest
import yaml
from orchestrator_program import PATIENCE, Program, until
from storm import TIMING, Storm, site
from unruly_cluster import UnrulyCluster

from skytether.api.client import Client
from skytether.lab.bench.scale import kubeconfig_of

pytestmark = [pytest.mark.slow, pytest.mark.postgres]

SEED = 16
BLOWS_S = 12.0
MOST_CALLS = 400
"""In a second."""
HANDOVER_S = 3.0
"""For so long at most an earlier run ends beside the next one."""


@pytest.fixture
def start(tmp_path: Path, postgres: str) -> Iterator[Callable[[str], Program]]:
    (tmp_path / "secrets").mkdir(mode=0o700)
    (tmp_path / "config.yaml").write_text(yaml.safe_dump({"timing": TIMING, "local_site": False}))
    shared = ("--database", postgres, "--secrets-dir", str(tmp_path / "secrets"))
    made: list[Program] = []

    def begin(name: str) -> Program:
        (tmp_path / name).mkdir()
        program = Program(tmp_path / name / "state", "--config", str(tmp_path / "config.yaml"), *shared)
        made.append(program)
        program.spawn()
        until(lambda: (program.folder / "address").exists(), program)
        return program

    yield begin
    for program in made:
        program.clean_up()


def test_no_instance_is_lost_begun_twice_or_left_and_the_api_server_is_not_flooded(
    start: Callable[[str], Program], tmp_path: Path
) -> None:
    cluster = UnrulyCluster(SEED, fails=0.05)
    with cluster.running() as address:
        programs = [start("one"), start("two")]
        token = (tmp_path / "secrets" / "operator.token").read_text().strip()

        def clients() -> list[Client]:
            """Of those that are up."""
            found = []
            for program in programs:
                with suppress(FileNotFoundError):  # it is killed at any moment
                    found.append(Client((program.folder / "address").read_text().strip(), token, timeout=5))
            return found

        storm = Storm(SEED, cluster, programs, clients)
        with clients()[0] as client:
            for name in ("ward", "hall"):
                client.create_site(site(name, kubeconfig_of(tmp_path, address)))
            storm.put_toy(client)
        storm.blow(BLOWS_S)
        deadline = time.monotonic() + 2 * PATIENCE
        until(lambda: len(clients()) == len(programs))
        with clients()[-1] as client:
            while wrong := storm.wrong(client):
                assert time.monotonic() < deadline, "\n".join([*wrong, *storm.notes])
                time.sleep(0.2)
        assert storm.counts["ask"] > 5, storm.counts
        assert cluster.doubles == []
        assert max(cluster.overlaps, default=0.0) < HANDOVER_S
        most, what = cluster.most_calls()
        assert most <= MOST_CALLS, what
