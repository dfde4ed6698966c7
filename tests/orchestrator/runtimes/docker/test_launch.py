"""Starts side by side, and what they choose: no engine needed."""

from __future__ import annotations

import base64
import socket
import threading
from collections.abc import Iterator
from typing import Any

import pytest

from skytether.api.grant import Grant
from skytether.api.manifest import ServiceSpec
from skytether.orchestrator.runtimes.base import Launch
from skytether.orchestrator.runtimes.docker import launch as docker_launch
from skytether.orchestrator.runtimes.docker.fence import Fence
from skytether.orchestrator.runtimes.docker.launch import Job
from skytether.orchestrator.runtimes.docker.options import DockerOptions
from skytether.orchestrator.runtimes.docker.seen import ContainerState

PATIENCE = 10.0


class Nobody:
    """Follows an engine on which nothing of ours is seen."""

    def seen(self, _timeout_s: float) -> list[ContainerState]:
        return []

    def of(self, _instance: str) -> list[ContainerState]:
        return []


class House:
    """Starts whose containers are none; the one called ``slow`` takes its time to be closed off."""

    def __init__(self) -> None:
        self.chosen: dict[str, tuple[int | None, tuple[int, ...]]] = {}
        self.waits = threading.Event()
        self.go_on = threading.Event()

    def wait(self) -> None:
        self.waits.set()
        self.go_on.wait(PATIENCE)

    def job(self, instance: str, given: dict[str, Any], **needs: Any) -> Job:
        house, anything = self, Nobody()

        class Begun(Job):
            def _begin(self, image: str, port: int | None, gpus: tuple[int, ...], *_: Any) -> ContainerState:
                house.chosen[instance] = port, gpus
                if instance == "slow":
                    house.wait()
                return ContainerState("c", instance, 1, "running")

        key = base64.b64encode(bytes(32)).decode()
        grant = Grant(
            instance=instance, service="toy", robot="walker", session_id="00112233445566aa", session_key=key, topics=()
        )
        launch = Launch(1, ServiceSpec.model_validate({"image": "toy", "needs": needs}), grant)
        options = DockerOptions.model_validate({"ports": (7600, 7602), "gpu": 2} | given)
        fake: Any = anything
        return Begun(launch, fake, options, "me", fake, lambda **_: None, fake, Fence(fake, "me"), None)


@pytest.fixture
def house(monkeypatch: pytest.MonkeyPatch) -> Iterator[House]:
    made = House()
    monkeypatch.setattr(docker_launch, "ensure_image", lambda *_: "sha256:1")
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: made.wait() or [(0, 0, 0, "", ("192.0.2.7", 1))])
    yield made
    made.go_on.set()


def ended(job: Job) -> bool:
    job.start()
    job.join(PATIENCE / 2)
    return job.ended and not job.failure


def test_a_start_that_takes_its_time_holds_no_other_up_and_neither_gets_what_the_other_has(house: House) -> None:
    slow = house.job("slow", {}, gpu=1)
    slow.start()
    assert house.waits.wait(PATIENCE)
    assert ended(house.job("other", {}, gpu=1))
    assert ended(house.job("elsewhere", {"engine": "ssh://edge"}, gpu=1))
    assert house.chosen == {"slow": (7600, (0,)), "other": (7601, (1,)), "elsewhere": (7600, (0,))}
    refused = house.job("third", {}, gpu=2)
    assert not ended(refused)
    assert "every GPU of the site is taken" in refused.failure
    house.go_on.set()
    slow.join(PATIENCE)
    assert ended(house.job("third", {}, gpu=2))
    assert house.chosen["third"] == (7600, (0, 1)), "what was chosen is free again, where no container has it"


def test_a_name_that_is_looked_up_for_long_holds_nobody_up(house: House) -> None:
    asking = house.job("asking", {}, egress=["slow.example:443"])
    asking.start()
    assert house.waits.wait(PATIENCE)
    assert ended(house.job("other", {}))
    house.go_on.set()
    asking.join(PATIENCE)
    assert not asking.failure
    assert house.chosen == {"asking": (7600, ()), "other": (7600, ())}
