"""Ways in which a robot outside reaches a pod, on a real cluster."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest
from docker_runs import launch, until
from kubernetes_house import OPERATOR, House
from kubernetes_site import KubernetesSite

from skytether.api.rest import State

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


def test_a_load_balancer_that_gives_no_address_is_given_up(kubernetes_site: KubernetesSite, tmp_path: Path) -> None:
    options = {"reach": "loadbalancer", "load_balancer_timeout_s": 1}
    with closing(kubernetes_site.open(tmp_path, **options)) as runtime:
        runtime.start(launch(kubernetes_site))

        def given_up() -> bool:
            runtime.tidy()
            return runtime.observe()["i1"].unstarted

        until(given_up, 90.0)
        assert runtime.observe()["i1"].detail == (
            "could not be started: the cluster's load balancer has given its Service no address within 1 s "
            "(option 'reach')"
        )
        runtime.dismantle()
        until(lambda: kubernetes_site.there("services") == [])
