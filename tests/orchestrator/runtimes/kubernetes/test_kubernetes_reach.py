"""Ways in which a robot outside reaches a pod, on a real cluster."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest
import yaml
from docker_runs import launch, until
from kubernetes_house import OPERATOR, House
from kubernetes_site import KubernetesSite

from skytether.api.rest import State
from skytether.orchestrator.runtimes.base import Phase

pytestmark = [pytest.mark.slow, pytest.mark.docker, pytest.mark.kubernetes]


@contextmanager
def opened(folder: Path, site: KubernetesSite, **options: object) -> Iterator[House]:
    house = House(folder, site, **options)
    try:
        yield house
    finally:
        house.core.stop()


@contextmanager
def cloud(site: KubernetesSite, address: str) -> Iterator[None]:
    """Gives each Service of the namespace this address, as the controller of a cloud does."""
    ended = threading.Event()
    status = {"status": {"loadBalancer": {"ingress": [{"ip": address}]}}}

    def serve() -> None:
        while not ended.wait(0.2):
            for one in site.there("services"):
                if not one["status"]["loadBalancer"]:
                    path = f"/api/v1/namespaces/{site.namespace}/services/{one['metadata']['name']}/status"
                    body = json.dumps(one | status)
                    site.kubectl("replace", "--raw", path, "-f", "-", given=body)

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def test_a_robot_is_driven_by_way_of_a_load_balancer(kubernetes_site: KubernetesSite, tmp_path: Path) -> None:
    with (
        opened(tmp_path / "state", kubernetes_site, reach="loadbalancer") as house,
        kubernetes_site.images.another("virtual-trail") as image,
    ):
        house.put_trail(image)
        instance = house.ask("trail")
        waiting = house.until(instance, State.STARTING, lambda record: "load balancer" in record.reason)
        assert "no address yet" in waiting.reason
        with cloud(kubernetes_site, "203.0.113.77"):  # by which the cluster's proxy forwards
            record = house.until(instance, State.RUNNING)
        assert (record.host, record.port) == ("203.0.113.77", 7600)
        house.drive(instance)
        house.core.instances.delete(OPERATOR, instance)
        house.until(instance, State.STOPPED)


def test_a_robot_in_the_clusters_network_is_driven_by_way_of_the_pods_address(
    kubernetes_site: KubernetesSite, tmp_path: Path
) -> None:
    with (
        opened(tmp_path / "state", kubernetes_site, reach="pod") as house,
        kubernetes_site.images.another("virtual-trail") as image,
    ):
        house.put_trail(image)
        instance = house.ask("trail")
        record = house.until(instance, State.RUNNING)
        (pod,) = kubernetes_site.there("pods")
        assert (record.host, record.port) == (pod["status"]["podIP"], 7600)
        house.drive(instance)
        house.core.instances.delete(OPERATOR, instance)
        house.until(instance, State.STOPPED)


class RelayProgram:
    """``skytether relay`` as a process, that knows of the cluster's pods what the docs' rights let it."""

    def __init__(self, site: KubernetesSite, folder: Path) -> None:
        site.give_account(site.role("skytether-relay"))
        cluster = {
            "kubeconfig": site.kubeconfig_of("skytether-relay", folder),
            "namespace": site.namespace,
            "owner": site.owner,
        }
        config = folder / "relay.yaml"
        config.write_text(yaml.safe_dump({"listen": {"host": "127.0.0.1"}, "kubernetes": cluster}))
        command = [sys.executable, "-m", "skytether.cli", "relay", "--config", str(config), "--json"]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        assert self._process.stderr is not None
        listens = next(line for line in self._process.stderr if "listens on UDP" in line)
        self.port = int(listens.rpartition(":")[2])

    def told(self) -> dict[str, Any]:
        """What it tells next, of the second that ends."""
        assert self._process.stdout is not None
        told: dict[str, Any] = json.loads(self._process.stdout.readline())
        return told

    def __enter__(self) -> RelayProgram:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.terminate()
        self._process.communicate()


def test_a_robot_is_driven_by_way_of_a_relay_that_follows_the_pods(
    kubernetes_site: KubernetesSite, tmp_path: Path
) -> None:
    with RelayProgram(kubernetes_site, tmp_path) as relay:
        options: dict[str, object] = {"reach": "relay", "relay": f"127.0.0.1:{relay.port}"}
        with (
            opened(tmp_path / "state", kubernetes_site, **options) as house,
            kubernetes_site.images.another("virtual-trail") as image,
        ):
            house.put_trail(image)
            instance = house.ask("trail")
            record = house.until(instance, State.RUNNING)
            assert (record.host, record.port) == ("127.0.0.1", relay.port)  # which is all that its robot is told
            session = house.drive(instance)
            flow = until(lambda: relay.told()["sessions"].get(session.id))
            assert min(flow["packets_up"], flow["packets_down"]) > 0
            # Its next run is another pod, at another address.
            kubernetes_site.kubectl("-n", kubernetes_site.namespace, "delete", "pods", "--all", "--wait=false")
            house.until(instance, State.RUNNING, lambda record: record.attempt > 1)
            house.drive(instance)
            house.core.instances.delete(OPERATOR, instance)
            house.until(instance, State.STOPPED)
        until(lambda: relay.told()["legs"] == 0)  # its route went with it


def test_a_load_balancer_that_gives_no_address_is_given_up(kubernetes_site: KubernetesSite, tmp_path: Path) -> None:
    options = {"reach": "loadbalancer", "load_balancer_timeout_s": 1}
    with closing(kubernetes_site.open(tmp_path, **options)) as runtime:
        runtime.start(launch(kubernetes_site))

        def given_up() -> bool:
            runtime.tidy()
            return runtime.observe()["i1"].phase is Phase.EXITED

        until(given_up, 90.0)
        assert runtime.observe()["i1"].unstarted
        assert runtime.observe()["i1"].detail == (
            "could not be started: the cluster's load balancer has given its Service no address within 1 s "
            "(option 'reach')"
        )
        runtime.dismantle()
        until(lambda: kubernetes_site.there("services") == [])
