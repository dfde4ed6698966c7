"""An orchestrator over one Kubernetes site, and a robot that a pod drives."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from kubernetes_site import LITTLE, KubernetesSite

from skytether.api.manifest import Manifest
from skytether.api.rest import InstanceCreate, Session, SiteCreate, State
from skytether.bridge import Bridge, SessionSpec
from skytether.messages import Header, JointState, Odometry, Time, Vector3, Wrench, WrenchStamped, encode
from skytether.orchestrator.access.access import Principal
from skytether.orchestrator.config.settings import Settings
from skytether.orchestrator.core import Orchestrator
from skytether.orchestrator.domain.records import Record
from skytether.orchestrator.runtimes.base import Runtime
from skytether.orchestrator.runtimes.kubernetes import KubernetesRuntime
from skytether.orchestrator.scheduling.runtime_entry_points import load_runtime
from skytether.wire.events import Event, MessageReceived
from skytether.wire.topic import Role

OPERATOR = Principal(None)
PATIENCE = 90.0


def find(name: str) -> type[Runtime]:
    return KubernetesRuntime if name == "kubernetes" else load_runtime(name)


class House:
    """Orchestrators one after the other over one state folder, with one Kubernetes site."""

    def __init__(self, folder: Path, site: KubernetesSite, **changes: object) -> None:
        """``changes`` of the site's options."""
        self.folder = folder
        self.site = site
        self.core = self._open()
        options = site.options(**changes)
        self.core.sites.add(SiteCreate(name="ward", tier="edge", runtime="kubernetes", options=options))
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
        self.core.catalog.put(name, Manifest.model_validate(document))

    def ask(self, service: str) -> str:
        asked = InstanceCreate(robot="walker", service=service, lease_s=600)
        return self.core.instances.create(OPERATOR, asked, None).id

    def put_trail(self, image: str) -> None:
        """The manifest of ``virtual-trail``, under the name ``trail`` and with this image."""
        shipped = self.core.catalog.get("virtual-trail").spec.model_dump(mode="json")
        self.put("trail", **shipped | {"image": image, "entrypoint": None, "needs": shipped["needs"] | LITTLE})

    def drive(self, instance: str) -> Session:
        """Be its robot until it has sent a velocity: somebody leans on the walker. Where it was reached."""
        session = self.core.instances.show(self.core.instances.get(OPERATOR, instance)).session
        assert session is not None
        be_driven(session, self.core.instances.claim_session(OPERATOR, instance, "0123456789abcdef").key)
        return session

    def until(self, instance: str, state: State, good: Callable[[Record], bool] = lambda _: True) -> Record:
        deadline = time.monotonic() + PATIENCE
        while True:
            record = self.core.instances.get(OPERATOR, instance)
            if record.state is state and good(record):
                return record
            assert time.monotonic() < deadline, f"{record.state}, attempt {record.attempt}: {record.reason}"
            time.sleep(0.02)


def be_driven(session: Session, key: str) -> None:
    """Be the robot of a session of ``virtual-trail`` until a velocity has come: somebody leans on the walker."""
    assert session.host is not None
    assert session.port is not None
    robot = Robot()
    spec = SessionSpec.from_api(Role.ROBOT, session.id, key, session.topics)
    with Bridge(spec, robot, bind=("0.0.0.0", 0), peer=(session.host, session.port)) as bridge:
        deadline = time.monotonic() + PATIENCE
        while not robot.heard.wait(0.02):
            assert time.monotonic() < deadline
            header = Header(Time.from_seconds(time.time()), "base_link")
            bridge.publish("force", encode(WrenchStamped(header, Wrench(force=Vector3(x=24.0)))))
            bridge.publish("wheels", encode(JointState(header, ("left_wheel", "right_wheel"), [0.0, 0.0])))
            bridge.publish("odom", encode(Odometry(header)))


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
