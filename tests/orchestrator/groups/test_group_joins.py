"""A group of OpenStack machines from the first robot to the last: made, joined by their user-data, given back.

The cloud speaks HTTP and the machines join over TLS, both on loopback; what is made up is that the machines are threads
of this process, and their engines.
"""

from __future__ import annotations

import base64
import contextlib
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from node_scene import NodeScene, ReachedRuntime, find_runtime, program, until
from openstack_cloud import OpenstackCloud

from skytether.api.client import ApiError, Client
from skytether.api.groups import GroupCreate, Stage
from skytether.api.rest import InstanceCreate
from skytether.node.join import join
from skytether.node.store import NodeError
from skytether.orchestrator.config.settings import Nodes, Settings, Timing
from skytether.orchestrator.core import Orchestrator
from skytether.orchestrator.groups import scaling
from skytether.orchestrator.http.app import create_app

# openstacksdk warns of itself.
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::PendingDeprecationWarning")]
QUICK = Timing(observe=0.02, observe_changing=0.005, place=0.05, stop_grace=0.1)
TEMPLATE = "#!/bin/sh\nskytether site join @SKYTETHER_URL@ --token @SKYTETHER_TOKEN@ # @SKYTETHER_NAME@\n"


class Machines:
    """What the cloud's servers do when they are started: each joins as its user-data says, and runs its node."""

    def __init__(self, scene: NodeScene, cloud: OpenstackCloud) -> None:
        self.scene, self.cloud = scene, cloud
        self.joins = True
        self.tokens: list[str] = []
        self.said: list[str] = []
        """Errors of joins."""
        self._ended = threading.Event()
        self._threads: list[threading.Thread] = []
        cloud.nova.on_created = self._boot

    def _boot(self, id_: str, asked: dict[str, Any]) -> None:
        words = base64.b64decode(asked["user_data"]).decode().split()
        url, token, name = words[words.index("join") + 1], words[words.index("--token") + 1], words[-1]
        assert (url, name) == (self.scene.url, asked["name"])
        self.tokens.append(token)
        if self.joins:
            self._threads.append(threading.Thread(target=self._run, args=(id_, name, token)))
            self._threads[-1].start()

    def _run(self, id_: str, name: str, token: str) -> None:
        self.scene.engine(name, NCPU=4)
        try:
            join(self.scene.options(token, name))
        except NodeError as error:
            self.said.append(str(error))
            return
        with program(self.scene.store(name)):
            while id_ in self.cloud.nova.servers and not self._ended.is_set():
                time.sleep(0.02)

    def end(self) -> None:
        self._ended.set()
        for thread in self._threads:
            thread.join()


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.fixture
def scene(tmp_path: Path, server: Any) -> Iterator[NodeScene]:
    ReachedRuntime.worlds.clear()
    port = free_port()
    nodes = Nodes(port=port, urls=(f"https://127.0.0.1:{port}",))
    settings = Settings(
        state_dir=tmp_path / "state",
        timing=QUICK,
        nodes=nodes,
        local_site=False,
        catalog={"modules": ["skytether.testing.toy_service"]},
    )
    core = Orchestrator(settings, find_runtime=find_runtime)
    core.start()
    server.app = create_app(core)
    server.share_routes()
    with Client(server.url, (tmp_path / "state" / "operator.token").read_text().strip()) as operator:
        spec = {"entrypoint": "skytether.testing.toy_service", "image": "toy", "needs": {"cpu": 3, "memory_mb": 1}}
        document = {"apiVersion": "skytether.io/v1", "kind": "Service", "metadata": {"name": "toy"}, "spec": spec}
        operator.put_service("toy", document)
        scene = NodeScene(core, operator, tmp_path)
        scene.shut()
        scene.port = port
        scene.open()
        yield scene
        scene.close()
    core.stop()


@pytest.fixture
def machines(scene: NodeScene) -> Iterator[Machines]:
    with OpenstackCloud() as cloud:
        machines = Machines(scene, cloud)
        yield machines
        machines.end()


def group(cloud: OpenstackCloud, folder: Path, **more: Any) -> GroupCreate:
    (folder / "machine.sh").write_text(TEMPLATE)
    options = {
        "cloud": "lab",
        "clouds_file": str(cloud.clouds_yaml(folder)),
        "flavor": "m1.large",
        "image": "debian-12",
        "network": "robots",
        "user_data": str(folder / "machine.sh"),
        "site": {"timeout_s": 5},
    }
    limits = {"max": 2, "grow_after_s": 0, "idle_s": 1, "cost": 4, **more}
    return GroupCreate.model_validate({"name": "cloud", "provider": "openstack", "options": options, **limits})


def test_machines_are_made_join_run_and_go(scene: NodeScene, machines: Machines, tmp_path: Path) -> None:
    operator, nova = scene.operator, machines.cloud.nova
    assert operator.create_group(group(machines.cloud, tmp_path)).cpu == 4
    ids = [operator.create_instance(InstanceCreate(robot=f"w{n}", service="toy", lease_s=600)).id for n in range(3)]
    until(lambda: [one.state.value for one in operator.instances()].count("running") == 2)
    until(lambda: [one.stage for one in operator.get_group("cloud").machines] == [Stage.READY] * 2)
    shown = operator.get_group("cloud")
    assert {one.id for one in shown.machines} == set(nova.servers)
    site = operator.get_site(shown.machines[0].name)
    assert (site.cost, site.tier, site.options["timeout_s"]) == (4, "cloud", 5)
    assert site.node is not None
    scene.engine("other")
    with pytest.raises(NodeError, match="was used at"):  # each is for one machine
        join(scene.options(machines.tokens[0], "other"))
    # Not always the last one: an instance whose start failed, for its machine's link was new, lets the next go first.
    full = "has all the machines that it may have (2)"
    until(lambda: [one.reason.endswith(full) for one in operator.instances()].count(True) == 1)

    for id_ in ids:
        operator.delete_instance(id_)
    until(lambda: not operator.get_group("cloud").machines)
    assert (nova.servers, operator.sites(), scene.core.nodes.all()) == ({}, [], {})
    assert len(nova.created) == 2
    assert operator.delete_group("cloud")


def test_a_lost_answer_and_a_machine_that_does_not_join(
    scene: NodeScene, machines: Machines, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scaling, "BACKOFF", 0.5)
    operator, nova = scene.operator, machines.cloud.nova
    machines.joins = False
    nova.lose.add("POST /servers")
    operator.create_group(group(machines.cloud, tmp_path, join_timeout_s=2))
    made = operator.create_instance(InstanceCreate(robot="w", service="toy", lease_s=600))
    until(lambda: "did not become a site within 2 s" in operator.get_group("cloud").reason)
    until(lambda: not nova.servers)
    machines.joins = True
    nova.lose.clear()
    assert operator.wait_running(made.id, timeout=60).placement.site.startswith("cloud-")
    ordered = [one["name"] for one in nova.created]
    assert len(ordered) == len(set(ordered)) >= 2, "one whose answer was lost is not ordered again"
    assert len(nova.servers) == 1
    scene.engine("late")
    with pytest.raises(NodeError, match="join token was good until"):
        join(scene.options(machines.tokens[0], "late"))


def test_a_group_whose_machines_could_not_join_is_refused(server: Any, tmp_path: Path) -> None:
    core = Orchestrator(Settings(state_dir=tmp_path / "state", timing=QUICK))
    core.start()
    server.app = create_app(core)
    with (
        OpenstackCloud() as cloud,
        Client(server.url, (tmp_path / "state" / "operator.token").read_text().strip()) as operator,
        contextlib.ExitStack() as stack,
    ):
        stack.callback(core.stop)
        with pytest.raises(ApiError, match=r"machines of 'openstack' join by themselves: first set nodes\.port"):
            operator.create_group(group(cloud, tmp_path))
        assert operator.groups() == []
