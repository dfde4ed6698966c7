"""A group of sites over the real Docker engine: a queue of containers makes it grow, and nothing is left at the end."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from docker_site import DockerSite

from skytether.api.groups import GroupCreate, Stage
from skytether.api.manifest import Manifest
from skytether.api.rest import InstanceCreate
from skytether.orchestrator.access.access import Principal
from skytether.orchestrator.config.settings import Settings
from skytether.orchestrator.core import Orchestrator

pytestmark = [pytest.mark.docker, pytest.mark.slow]

OPERATOR = Principal(None)
MOST = 2


def until(seen: Callable[[], Any], what: Callable[[], object], patience: float = 90.0) -> None:
    deadline = time.monotonic() + patience
    while not seen():
        assert time.monotonic() < deadline, what()
        time.sleep(0.05)


def test_a_queue_of_containers_grows_it_to_its_max_and_all_is_gone_when_they_have_ended(
    docker_site: DockerSite, tmp_path: Path
) -> None:
    core = Orchestrator(Settings(state_dir=tmp_path / "state", local_site=False))
    core.start()
    try:
        grow_and_shrink(core, docker_site)
    finally:
        core.stop()


def grow_and_shrink(core: Orchestrator, docker: DockerSite) -> None:
    spec = {"image": docker.images.toy, "needs": {"cpu": 1}, "params": {"type": "object"}}
    document = {"apiVersion": "skytether.io/v1", "kind": "Service", "metadata": {"name": "toy"}, "spec": spec}
    core.catalog.put("toy", Manifest.model_validate(document))
    given = {key: value for key, value in docker.options().items() if key not in ("owner", "network")}
    options = {"runtime": "docker", "cpu": 1, "options": given}
    asked = GroupCreate(name="cloud", provider="local", options=options, max=MOST, grow_after_s=0, idle_s=1)
    core.groups.add(asked)
    owner = core.groups.row("cloud").owner

    def left(kind: str = "container") -> list[str]:
        """What is at the engine of any machine of the group."""
        labels = docker.docker(kind, "ls", *(["-a"] if kind == "container" else []), "--format", "{{.Labels}}")
        return [line for line in labels.splitlines() if owner in line]

    def states() -> list[str]:
        return sorted(record.state.value for record in core.store.live())

    def told() -> object:
        return core.store.site_groups(), core.store.machines(), [r.reason for r in core.store.live()]

    queue = [
        core.instances.create(OPERATOR, InstanceCreate(robot=f"w{n}", service="toy", lease_s=600), None).id
        for n in range(MOST + 2)
    ]
    until(lambda: states() == ["pending"] * 2 + ["running"] * MOST, told)
    assert [machine.stage for machine in core.store.machines()] == [Stage.READY] * MOST
    ran: set[str] = set()
    while len(ran) < len(queue):  # each has its turn, and no more machines come
        now = {record.id for record in core.store.live() if record.state.value == "running"}
        ran |= now
        for instance in now:
            core.instances.delete(OPERATOR, instance)
        until(lambda: {r.id for r in core.store.live() if r.state.value == "running"} or not core.store.live(), told)
        assert len(core.store.machines()) <= MOST
    assert ran == set(queue)
    until(lambda: not core.store.machines(), told)
    assert core.store.sites() == []
    assert (left(), left("network"), left("volume")) == ([], [], [])
    assert core.groups.delete("cloud")
