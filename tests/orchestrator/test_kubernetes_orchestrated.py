"""An orchestrator with a Kubernetes site: a robot outside is driven by a pod, and what becomes of instances."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from kubernetes_site import KubernetesSite

from skytether.api.manifest import Manifest
from skytether.api.rest import InstanceCreate, SiteCreate, State
from skytether.bridge import Bridge, SessionSpec
from skytether.messages import Header, JointState, Odometry, Time, Vector3, Wrench, WrenchStamped, encode
from skytether.orchestrator.access import Principal
from skytether.orchestrator.core import Orchestrator
from skytether.orchestrator.records import Record
from skytether.orchestrator.runtimes.base import Runtime
from skytether.orchestrator.runtimes.kubernetes import KubernetesRuntime
from skytether.orchestrator.settings import Settings
from skytether.orchestrator.sites import load_runtime
from skytether.wire.events import Event, MessageReceived
from skytether.wire.topic import Role

pytestmark = [pytest.mark.slow, pytest.mark.docker, pytest.mark.kubernetes]

OPERATOR = Principal(None)
PATIENCE = 90.0


def find(name: str) -> type[Runtime]:
    return KubernetesRuntime if name == "kubernetes" else load_runtime(name)


class House:
    """Orchestrators one after the other over one state folder, with one Kubernetes site."""

    def __init__(self, folder: Path, site: KubernetesSite) -> None:
        self.folder = folder
        self.site = site
        self.core = self._open()
        self.core.sites.add(SiteCreate(name="ward", tier="edge", runtime="kubernetes", options=site.options()))
        self.core.sites.delete("local")

    def _open(self) -> Orchestrator:
        core = Orchestrator(Settings(state_dir=self.folder), find_runtime=find)
        core.start()
        return core

    def restart(self) -> None:
        self.core.stop()
        self.core = self._open()

    def put(self, name: str, **spec: Any) -> None:
        document = {"apiVersion": "skytether.io/v1", "kind": "Service", "metadata": {"name": name}, "spec": spec}
        self.core.catalogue.put(name, Manifest.model_validate(document))

    def ask(self, service: str) -> str:
        asked = InstanceCreate(robot="walker", service=service, lease_s=600)
        return self.core.instances.create(OPERATOR, asked, None).id

    def until(self, instance: str, state: State, good: Callable[[Record], bool] = lambda _: True) -> Record:
        deadline = time.monotonic() + PATIENCE
        while True:
            record = self.core.instances.get(OPERATOR, instance)
            if record.state is state and good(record):
                return record
            assert time.monotonic() < deadline, f"{record.state}: {record.reason}"
            time.sleep(0.02)


@pytest.fixture
def house(tmp_path: Path, kubernetes_site: KubernetesSite) -> Iterator[House]:
    house = House(tmp_path / "state", kubernetes_site)
    yield house
    house.core.stop()


class Robot:
    """The robot's end: notes which topics it heard."""

    def __init__(self) -> None:
        self.heard = threading.Event()

    def attach(self, publisher: object) -> None:
        pass

    def deliver(self, message: MessageReceived) -> None:
        if message.topic == "cmd_vel":
            self.heard.set()

    def notify(self, event: Event) -> None:
        pass


def test_a_robot_outside_is_driven_by_a_pod(house: House) -> None:
    trail = house.core.catalogue.get("virtual-trail")
    image = house.site.images.name("virtual-trail")
    with house.site.images.another("virtual-trail"):
        house.put("trail", **trail.spec.model_dump(mode="json") | {"image": image, "entrypoint": None})
        record = house.until(house.ask("trail"), State.RUNNING)
        session = house.core.instances.show(record).session
        assert session is not None
        assert session.host is not None
        assert session.port is not None
        key = house.core.instances.claim_session(OPERATOR, record.id, "0123456789abcdef").key
        robot = Robot()
        spec = SessionSpec.from_api(Role.ROBOT, session.id, key, session.topics)
        with Bridge(spec, robot, bind=("0.0.0.0", 0), peer=(session.host, session.port)) as bridge:
            deadline = time.monotonic() + PATIENCE
            while not robot.heard.wait(0.02):  # somebody leans on the walker
                assert time.monotonic() < deadline
                header = Header(Time.from_seconds(time.time()), "base_link")
                bridge.publish("force", encode(WrenchStamped(header, Wrench(force=Vector3(x=24.0)))))
                bridge.publish("wheels", encode(JointState(header, ("left_wheel", "right_wheel"), [0.0, 0.0])))
                bridge.publish("odom", encode(Odometry(header)))
        house.core.instances.delete(OPERATOR, record.id)
        house.until(record.id, State.STOPPED)


def test_an_instance_outlives_the_orchestrator_and_is_started_again_when_its_pod_is_deleted(house: House) -> None:
    house.put("toy", image=house.site.images.toy, params={"additionalProperties": True})
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
