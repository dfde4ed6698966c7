"""An orchestrator on a real cluster under faults: after each no orphan, no lost instance, no double start."""

from __future__ import annotations

import json
import logging
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from kubernetes_site import LITTLE, KubernetesSite

from skytether.api.client import Client
from skytether.api.manifest import Manifest
from skytether.api.rest import Instance, InstanceCreate, Site, SiteCreate, State
from skytether.lab.embedded import EmbeddedOrchestrator

pytestmark = [pytest.mark.slow, pytest.mark.docker, pytest.mark.kubernetes]

log = logging.getLogger(__name__)

_TIMING = {"SKYTETHER_TIMING_MAX_FAILURES": "3", "SKYTETHER_TIMING_START_TIMEOUT": "120"}
"""Fewer starts of what crashes, and none given up because the machine is busy."""

LIVE = (State.PENDING, State.PLACING, State.STARTING, State.RUNNING)


def until(condition: Callable[[], Any]) -> Any:
    limit = time.monotonic() + 120
    while not (found := condition()):
        assert time.monotonic() < limit
        time.sleep(0.25)  # most looks are a program, which takes a tenth of a second of a processor
    return found


class Scene:
    """An orchestrator of its own process over one Kubernetes site, and what both say of the same instances."""

    def __init__(
        self, orchestrator: EmbeddedOrchestrator, operator: Client, site: KubernetesSite, **options: object
    ) -> None:
        self.orchestrator = orchestrator
        self.operator = operator
        self.site = site
        operator.create_site(
            SiteCreate(name="ward", tier="edge", runtime="kubernetes", options=site.options(**options))
        )
        operator.delete_site("local")
        self.put()

    def put(self, **needs: Any) -> None:
        spec = {"image": self.site.images.toy, "params": {"additionalProperties": True}, "needs": LITTLE | needs}
        document = {"apiVersion": "skytether.io/v1", "kind": "Service", "metadata": {"name": "toy"}, "spec": spec}
        self.operator.put_service("toy", Manifest.model_validate(document))

    def ask(self, **params: Any) -> str:
        asked = InstanceCreate(robot="walker", service="toy", lease_s=3600, params=params)
        return self.operator.create_instance(asked).id

    def until(self, instance: str, good: Callable[[Instance], bool]) -> Instance:
        """Wait for what is to become of an instance."""
        limit = time.monotonic() + 120
        while not good(found := self.operator.get_instance(instance)):
            assert time.monotonic() < limit, f"{found.state}: {found.reason}"
            time.sleep(0.05)
        return found

    def until_run(self, *instances: str) -> None:
        for instance in instances:
            self.until(instance, lambda one: one.state is State.RUNNING)

    def pods(self) -> list[dict[str, Any]]:
        return self.site.there("pods", f"skytether.io/owner={self.site.owner}")

    def running(self) -> list[str]:
        """The instances of pods that run, one for each pod.

        Of one that was asked to end old nodes say for ever that its container runs, and also that it has failed.
        """
        there = [one for one in self.pods() if one["status"].get("phase") == "Running"]
        up = [one for one in there if any(s["state"].get("running") for s in states(one))]
        return sorted(one["metadata"]["labels"]["skytether.io/instance"] for one in up)

    def settled(self) -> None:
        """What runs is what should, each once, and nothing is there that belongs to no pod."""
        until(lambda: self.running() == sorted(one.id for one in self.operator.instances() if one.state in LIVE))
        uids = {one["metadata"]["uid"] for one in self.pods()}

        def no_orphan() -> bool:
            secrets = self.site.there("secrets", f"skytether.io/owner={self.site.owner}")
            return all(one["metadata"]["ownerReferences"][0]["uid"] in uids for one in secrets)

        until(no_orphan)

    def end(self, *instances: str) -> None:
        for instance in instances:
            self.operator.delete_instance(instance)
        for instance in instances:
            self.until(instance, lambda one: one.state.final)


def states(pod: dict[str, Any]) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = pod["status"].get("containerStatuses", [])
    return found


@contextmanager
def opened(site: KubernetesSite, **options: object) -> Iterator[Scene]:
    with (
        EmbeddedOrchestrator(environment=_TIMING) as orchestrator,
        Client(orchestrator.url, orchestrator.operator_token) as operator,
    ):
        yield Scene(orchestrator, operator, site, **options)


@pytest.fixture
def scene(kubernetes_site: KubernetesSite) -> Iterator[Scene]:
    with opened(kubernetes_site) as scene:
        yield scene


def test_eviction_a_kill_in_mid_start_and_a_quota_cost_no_instance(scene: Scene) -> None:
    space = ("-n", scene.site.namespace)
    # Evicted, where nobody has kept the budget that stands against it: begun anew, once.
    first = scene.ask()
    scene.until_run(first)
    (pod,) = scene.pods()
    scene.site.kubectl(*space, "delete", "poddisruptionbudgets", "--all")
    until(lambda: not evict(scene.site, pod["metadata"]["name"]))
    again = scene.until(first, lambda one: one.state is State.RUNNING and one.restarts > 0)
    assert again.restarts == 1
    scene.settled()
    # Killed while it starts several: the next one takes over what was begun, and begins the others.
    asked = [scene.ask() for _ in range(3)]
    until(lambda: len(scene.pods()) > 1)
    scene.orchestrator.kill()
    scene.orchestrator.start()
    scene.until_run(first, *asked)
    scene.settled()
    assert all(scene.operator.get_instance(one).restarts == 0 for one in asked)
    scene.end(*asked)
    # Beyond a quota: refused in the cluster's words, and nothing is left of it; there is room again, and it runs.
    scene.site.kubectl(*space, "create", "quota", "few", f"--hard=count/pods={len(scene.pods())}")
    try:
        until(lambda: scene.site.there("resourcequotas")[0]["status"].get("used"))
        refused = scene.ask()
        scene.until(refused, lambda one: "exceeded quota: few" in one.reason)
    finally:
        scene.site.kubectl(*space, "delete", "quota", "few")
    late = scene.until(refused, lambda one: one.state in (State.RUNNING, State.FAILED))
    if late.state is State.FAILED:  # it was refused for as long as that may take
        refused = scene.ask()
        scene.until_run(refused)
    scene.settled()
    # A service that crashes again and again is given up, with its last line.
    broken = scene.ask(say="no wheels", exit_status=3)
    given_up = scene.until(broken, lambda one: one.state is State.FAILED).reason
    assert re.search(r'given up after \d failures in a row: .* exit status 3; its last line: "no wheels"', given_up)
    scene.end(first, refused)
    scene.settled()


def evict(site: KubernetesSite, pod: str) -> str:
    """Ask for it as who drains a node does; what the cluster says against it."""
    body = {"apiVersion": "policy/v1beta1", "kind": "Eviction", "metadata": {"name": pod, "namespace": site.namespace}}
    path = f"/api/v1/namespaces/{site.namespace}/pods/{pod}/eviction"
    command = ["kubectl", "--kubeconfig", site.kubeconfig, "create", "--raw", path, "-f", "-"]
    return subprocess.run(command, capture_output=True, text=True, input=json.dumps(body)).stderr


class Way:
    """A way to the API server that can stand still: for who goes by it the server does, and for nobody else."""

    PROGRAM = """
import asyncio, sys

async def pump(reader, writer):
    try:
        while piece := await reader.read(65536):
            writer.write(piece)
            await writer.drain()
    except OSError:
        pass
    writer.close()

async def serve(reader, writer):
    there, back = await asyncio.open_connection(sys.argv[1], int(sys.argv[2]))
    await asyncio.gather(pump(reader, back), pump(there, writer))

async def main():
    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    print(server.sockets[0].getsockname()[1], flush=True)
    await server.serve_forever()

asyncio.run(main())
"""

    def __init__(self, site: KubernetesSite, folder: Path) -> None:
        document = json.loads(site.kubectl("config", "view", "--raw", "-o", "json"))
        cluster = document["clusters"][0]["cluster"]
        server = urlsplit(cluster["server"])
        command = [sys.executable, "-c", self.PROGRAM, str(server.hostname), str(server.port)]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert self._process.stdout is not None
        cluster["server"] = f"{server.scheme}://127.0.0.1:{int(self._process.stdout.readline())}"
        self.kubeconfig = folder / "way.kubeconfig"
        self.kubeconfig.write_text(json.dumps(document))

    @contextmanager
    def standing(self) -> Iterator[None]:
        self._process.send_signal(signal.SIGSTOP)
        try:
            yield
        finally:
            self._process.send_signal(signal.SIGCONT)

    def close(self) -> None:
        self._process.kill()
        self._process.communicate()


@pytest.fixture
def way(kubernetes_site: KubernetesSite, tmp_path: Path) -> Iterator[Way]:
    with closing(Way(kubernetes_site, tmp_path)) as made:
        yield made


def test_an_api_server_that_stands_still_for_half_a_minute_ends_nothing(
    kubernetes_site: KubernetesSite, way: Way
) -> None:
    with opened(kubernetes_site, kubeconfig=str(way.kubeconfig)) as scene:
        first = scene.ask()
        scene.until_run(first)
        before = [one["metadata"]["uid"] for one in scene.pods()]

        def site() -> Site:
            return next(one for one in scene.operator.sites() if one.name == "ward")

        with way.standing():
            begun = time.monotonic()
            late = scene.ask()
            until(lambda: "does not answer" in site().reason)
            until(lambda: time.monotonic() - begun > 30)
            assert scene.operator.get_instance(first).state is State.RUNNING
        scene.until_run(first, late)
        assert scene.operator.get_instance(first).restarts == 0
        assert scene.operator.get_instance(late).restarts == 0
        assert before[0] in [one["metadata"]["uid"] for one in scene.pods()]
        scene.settled()
        scene.end(first, late)


def test_two_sites_in_two_namespaces_know_nothing_of_each_other(scene: Scene) -> None:
    with closing(KubernetesSite(scene.site.images, scene.site.kubeconfig)) as other:
        other.begin()
        scene.operator.create_site(
            SiteCreate(name="yard", tier="edge", runtime="kubernetes", options=other.options(), cost=1e6)
        )
        here = scene.ask()
        scene.until_run(here)
        there = scene.operator.migrate_instance(here, "yard").id
        scene.until_run(there)
        assert [one["metadata"]["labels"]["skytether.io/instance"] for one in other.there("pods")] == [there]
        assert scene.running() == [here]
        scene.end(here)
        scene.operator.delete_site("ward")
        assert scene.operator.get_instance(there).state is State.RUNNING
        assert scene.pods() == []
        scene.end(there)


def test_a_standby_is_given_out_without_a_start_and_a_service_that_is_not_well_is_begun_anew(scene: Scene) -> None:
    scene.put(standby=1)

    def warm() -> list[Instance]:
        return [one for one in scene.operator.instances() if not one.robot and one.state is State.RUNNING]

    standby = until(warm)[0]
    pods = {one["metadata"]["uid"] for one in scene.pods()}
    given = scene.operator.create_instance(InstanceCreate(robot="walker", service="toy", lease_s=3600))
    assert (given.id, given.state, given.restarts) == (standby.id, State.RUNNING, 0)
    assert pods <= {one["metadata"]["uid"] for one in scene.pods()}
    until(lambda: [one for one in warm() if one.id != standby.id])
    scene.put(standby=0)
    until(lambda: scene.running() == [given.id])
    (pod,) = [one for one in scene.pods() if one["metadata"]["labels"]["skytether.io/instance"] == given.id]
    forget = "import os; os.remove('/run/skytether/instance/ready.json')"  # so it is not ready, says the SDK
    name = pod["metadata"]["name"]
    scene.site.kubectl("-n", scene.site.namespace, "exec", name, "--", "/app/bin/python", "-c", forget)
    begun = time.monotonic()
    ill = scene.until(given.id, lambda one: one.restarts == 1)
    log.info("seen after %.2f s", time.monotonic() - begun)
    assert "is not well: the service is not ready" in ill.reason or ill.state is State.RUNNING
    scene.until_run(given.id)
    scene.settled()
    scene.end(given.id)
