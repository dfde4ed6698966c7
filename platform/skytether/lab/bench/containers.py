"""What the benchmarks do with the Docker engine of this machine, or of DOCKER_HOST, by its command line."""

from __future__ import annotations

import base64
import os
import secrets
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from skytether.api.client import ApiError, Client
from skytether.api.grant import GRANT_VARIABLE, Grant
from skytether.api.manifest import TopicSpec
from skytether.api.rest import SiteCreate
from skytether.lab.bench.pair import BenchError
from skytether.lab.embedded import EmbeddedOrchestrator

_LIMIT_S = 60.0
_LOOK_S = 0.005
_INSIDE = "/run/skytether/instance"
_PORT = 7600


@dataclass(frozen=True)
class ServiceImage:
    """What a site of the benchmark runs."""

    service: str
    image: str
    topics: tuple[TopicSpec, ...]


@contextmanager
def docker_site(
    orchestrator: EmbeddedOrchestrator, prefix: str, service: str, bind_host: str | None = None
) -> Iterator[ServiceImage]:
    """Make this machine's engine the only site, and remove what is left there in the end; gives what it runs.

    Args:
        orchestrator: Whose site it is.
        prefix: Of the images' names.
        service: The one that is to run.
        bind_host: Address on which its instances are reached; None: the site's own default.

    Raises:
        BenchError: There is no such image, or no engine.
    """
    owner = f"bench-{secrets.token_hex(4)}"
    options = {"owner": owner, "network": f"skytether-{owner}", "guard_image": f"{prefix}guard:1", "pull": "never"}
    if bind_host is not None:
        options["bind_host"] = bind_host
    if "DOCKER_HOST" in os.environ:  # as the command line has it
        options["engine"] = os.environ["DOCKER_HOST"]
    image = f"{prefix}{service}:1"
    docker("image", "inspect", image, options["guard_image"])
    try:
        with Client(orchestrator.url, orchestrator.operator_token) as operator:
            manifest = operator.get_service(service)
            spec = manifest.spec.model_copy(update={"image": image})
            operator.put_service(service, manifest.model_copy(update={"spec": spec}))
            operator.create_site(SiteCreate(name="docker", tier="edge", runtime="docker", options=options))
            operator.delete_site("local")
    except ApiError as error:
        raise BenchError(str(error)) from error
    try:
        yield ServiceImage(service, image, manifest.spec.topics)
    finally:
        orchestrator.stop()
        clean(owner, options["network"])


def gateway() -> str:
    """This machine's address on the engine's own network.

    What comes to it goes to a container as a robot's packets do that come from elsewhere: by the kernel. What comes to
    loopback is passed on by a process of the engine, which must wait for a processor each time.
    """
    return docker("network", "inspect", "bridge", "--format", "{{(index .IPAM.Config 0).Gateway}}").strip()


def clean(owner: str, network: str) -> None:
    """Remove what a site left on the engine."""
    deadline = time.monotonic() + _LIMIT_S
    while containers := docker("ps", "-aq", "--filter", f"label=skytether.io/owner={owner}").split():
        try:
            docker("rm", "-f", "-v", *containers)
        except BenchError:  # the site removes one itself just now
            if time.monotonic() > deadline:
                raise
            time.sleep(_LOOK_S)
    volumes = docker("volume", "ls", "-q", "--filter", f"name=skytether-{owner}-").split()
    if volumes:
        docker("volume", "rm", *volumes)
    docker("network", "rm", network)


def docker_run(service: ServiceImage) -> float:
    """Time from ``docker run`` of the service's image until it listens [s].

    Raises:
        BenchError: It did not.
    """
    with tempfile.TemporaryDirectory(prefix="skytether-") as folder:
        grant, ready = Path(folder) / "grant.json", Path(folder) / "ready.json"
        grant.touch(0o600)
        grant.write_text(_grant(service).model_dump_json())
        command = ["run", "-d", "--pull", "never", "--init", "--user", f"{os.geteuid()}:{os.getegid()}"]
        command += ["-v", f"{folder}:{_INSIDE}", "-e", f"{GRANT_VARIABLE}={_INSIDE}/grant.json"]
        command += ["-p", f"127.0.0.1::{_PORT}/udp", service.image]
        begun = time.monotonic()
        container = docker(*command)
        try:
            while not ready.exists():
                if time.monotonic() - begun > _LIMIT_S:
                    raise BenchError(f"docker run: not ready within {_LIMIT_S:.0f} s: {docker('logs', container)}")
                time.sleep(_LOOK_S)
            return time.monotonic() - begun
        finally:
            docker("rm", "-f", "-v", container)


def _grant(service: ServiceImage) -> Grant:
    return Grant(
        instance="bench",
        service=service.service,
        robot="bench",
        session_id=secrets.token_hex(8),
        session_key=base64.b64encode(secrets.token_bytes(32)).decode(),
        topics=service.topics,
        bind_host="0.0.0.0",  # noqa: S104 (in its own network)
        bind_port=_PORT,
        ready_file=f"{_INSIDE}/ready.json",
        data_dir=_INSIDE,
    )


def docker(*arguments: str) -> str:
    """What the command says.

    Raises:
        BenchError: It failed, or there is none.
    """
    try:
        done = subprocess.run(["docker", *arguments], capture_output=True, text=True, check=False)  # noqa: S607
    except FileNotFoundError:
        raise BenchError("the program 'docker' is missing: install docker.io") from None
    if done.returncode:
        raise BenchError(f"docker {arguments[0]}: {done.stderr.strip()}; `make images` builds the images")
    return done.stdout.strip()
