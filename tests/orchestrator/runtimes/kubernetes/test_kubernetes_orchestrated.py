"""An orchestrator with a Kubernetes site: a robot outside is driven by a pod, and what becomes of instances."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from kubernetes_house import OPERATOR, House
from kubernetes_site import LITTLE, KubernetesSite

from skytether.api.rest import State

pytestmark = [pytest.mark.slow, pytest.mark.docker, pytest.mark.kubernetes]


@pytest.fixture
def house(tmp_path: Path, kubernetes_site: KubernetesSite) -> Iterator[House]:
    house = House(tmp_path / "state", kubernetes_site)
    yield house
    house.core.stop()


def test_a_robot_outside_is_driven_by_a_pod(house: House) -> None:
    with house.site.images.another("virtual-trail") as image:
        house.put_trail(image)
        instance = house.ask("trail")
        house.until(instance, State.RUNNING)
        house.drive(instance)
        house.core.instances.delete(OPERATOR, instance)
        house.until(instance, State.STOPPED)


def test_an_instance_outlives_the_orchestrator_and_is_started_again_when_its_pod_is_deleted(house: House) -> None:
    house.put("toy", image=house.site.images.toy, params={"additionalProperties": True}, needs=LITTLE)
    instance = house.ask("toy")
    before = house.until(instance, State.RUNNING)
    pods = [one["metadata"]["uid"] for one in house.site.there("pods")]
    house.restart()
    after = house.until(instance, State.RUNNING)
    assert (after.port, after.attempt, after.restarts) == (before.port, 1, 0)
    assert [one["metadata"]["uid"] for one in house.site.there("pods")] == pods
    house.site.kubectl("-n", house.site.namespace, "delete", "pods", "--all", "--wait=false")
    again = house.until(instance, State.RUNNING, lambda record: record.attempt == 2)
    assert again.restarts == 1
    house.core.instances.delete(OPERATOR, instance)
    house.until(instance, State.STOPPED)
