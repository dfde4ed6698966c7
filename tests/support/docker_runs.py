"""What tests of the Docker runtime on a real engine ask of it, and of the engine."""

from __future__ import annotations

import base64
import json
import subprocess
import time
from collections.abc import Callable
from typing import Any

from docker_site import DockerSite
from kubernetes_site import LITTLE, KubernetesSite

from skytether.api.grant import Grant
from skytether.api.manifest import ServiceSpec
from skytether.orchestrator.runtimes.base import Launch, Observation, Phase
from skytether.orchestrator.runtimes.docker import DockerRuntime

KEY = base64.b64encode(bytes(range(32))).decode()
PATIENCE = 30.0
PYTHON = "/app/bin/python"


def launch(site: DockerSite | KubernetesSite, instance: str = "i1", attempt: int = 1, **more: Any) -> Launch:
    params, image = more.pop("params", {}), more.pop("image", site.images.toy)
    if isinstance(site, KubernetesSite):
        more["needs"] = {**LITTLE, **more.get("needs", {})}
    grant = Grant(
        instance=instance,
        service="toy",
        robot="walker",
        params=params,
        session_id="00112233445566aa",
        session_key=KEY,
        topics=(),
    )
    return Launch(attempt, ServiceSpec.model_validate({"image": image, **more}), grant)


def until(what: Callable[[], Any], patience_s: float = PATIENCE) -> Any:
    """Wait for a condition; gives what it gave."""
    deadline = time.monotonic() + patience_s
    while not (found := what()):
        assert time.monotonic() < deadline, "it did not come to pass"
        time.sleep(0.02)
    return found


def until_phase(runtime: DockerRuntime, phase: Phase, instance: str = "i1") -> Observation:
    def there() -> Observation | None:
        seen = runtime.observe().get(instance)
        return seen if seen is not None and seen.phase is phase else None

    return until(there)


def docker(*arguments: str, check: bool = True) -> str:
    done = subprocess.run(["docker", *arguments], capture_output=True, text=True)
    assert not check or done.returncode == 0, done.stderr
    return done.stdout.strip()


def inside(container: str, program: str) -> Any:
    """What a Python program in the container prints, as JSON."""
    return json.loads(docker("exec", container, PYTHON, "-c", program))
