"""How soon a machine that has nothing but a Docker engine drives a robot, step by step."""

from __future__ import annotations

import json
import os
import secrets
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from skytether.api.client import Client
from skytether.api.rest import Invite, RobotCreate, Site
from skytether.lab.bench.containers import clean, docker
from skytether.lab.bench.pair import BenchError
from skytether.lab.bench.start import ROBOT, first_command
from skytether.lab.bench.start_robots import ROBOTS, Watch
from skytether.lab.embedded import EmbeddedOrchestrator
from skytether.robot.agent.config import AgentConfig

_SERVICE = "virtual-trail"
_NODE = "bench-node"
_WHOLE = "join: all of the command"
_LIMIT_S = 60.0
_LOOK_S = 0.02
_STEPS = {
    "checks": "join: engine, memory, disk, ports, clock, address",
    "token": "join: the token is looked at",
    "certificate": "join: key, certificate, site",
    "keys": "join: kept on the disk",
    "site": "join: linked, and the site answers",
}


@dataclass(frozen=True, slots=True)
class JoinRow:
    """One step.

    Attributes:
        step: What is done.
        took_s: How long it took [s].
    """

    step: str
    took_s: float

    def document(self) -> dict[str, object]:
        """For ``--json``."""
        return asdict(self)


def bench_join(prefix: str = "skytether/", on_step: Callable[[str], object] = lambda _: None) -> list[JoinRow]:
    """Have this machine's engine join an orchestrator of our own, and a robot driven by what starts there.

    Args:
        prefix: Of the images' names, which the engine has.
        on_step: Called as each step begins.

    Raises:
        BenchError: A step did not work.
    """
    rows: list[JoinRow] = []

    @contextmanager
    def step(name: str) -> Iterator[None]:
        on_step(name)
        began = time.monotonic()
        yield
        rows.append(JoinRow(name, round(time.monotonic() - began, 4)))

    owner = f"bench-{secrets.token_hex(4)}"
    options = {"owner": owner, "network": f"skytether-{owner}", "guard_image": f"{prefix}guard:1", "pull": "never"}
    docker("image", "inspect", f"{prefix}{_SERVICE}:1", options["guard_image"])
    environment = {"SKYTETHER_NODES_PORT": "0", "SKYTETHER_LOCAL_SITE": "false"}
    with tempfile.TemporaryDirectory(prefix="skytether-") as folder, EmbeddedOrchestrator(None, environment) as house:
        url = (house.state_dir / "nodes.address").read_text().strip()
        try:
            with Client(house.url, house.operator_token) as operator:
                _use_image(operator, f"{prefix}{_SERVICE}:1")
                with step("invite: a token is made"):
                    token = operator.invite(Invite(name=_NODE, options=options)).token
                with step(_WHOLE):
                    joined = _join(url, token, Path(folder))
                rows[-1:-1] = [JoinRow(_STEPS[name], round(took, 4)) for name, took in joined["took_s"].items()]
                with _running(Path(folder)):
                    with step("run: the node's program starts and is linked"):
                        _until(operator, lambda site: site.state == "ready")
                    with step("robot: from its request to its first velocity command"):
                        _drive(operator, house.url)
                    house.stop()  # by way of the node: what runs there ends
        finally:
            house.kill()
            clean(owner, options["network"])
    whole = sum(row.took_s for row in rows if not row.step.startswith("join: ") or row.step == _WHOLE)
    return [*rows, JoinRow("all", round(whole, 4))]


def _drive(operator: Client, url: str) -> None:
    asking, watch = ROBOTS[_SERVICE](), Watch()
    token = operator.create_robot(RobotCreate(name=ROBOT, services=(_SERVICE,))).token
    with asking.agent(AgentConfig(ROBOT, url, _SERVICE, token, params=asking.params), watch) as agent:
        first_command(agent, None)


def _use_image(operator: Client, image: str) -> None:
    manifest = operator.get_service(_SERVICE)
    operator.put_service(
        _SERVICE, manifest.model_copy(update={"spec": manifest.spec.model_copy(update={"image": image})})
    )


def _join(url: str, token: str, folder: Path) -> Mapping[str, Any]:
    command = [sys.executable, "-m", "skytether.cli", "site", "join", url, "--token-file", "-", "--folder", str(folder)]
    command += ["--no-unit", "--advertise", "127.0.0.1", "--echo-port", "0", "--json"]
    done = subprocess.run(command, input=token, capture_output=True, text=True, timeout=2 * _LIMIT_S)
    if done.returncode:
        raise BenchError(f"skytether site join: {done.stderr.strip()}")
    document: dict[str, Any] = json.loads(done.stdout)
    return document


@contextmanager
def _running(folder: Path) -> Iterator[None]:
    command = [sys.executable, "-m", "skytether.cli", "site", "run", "--folder", str(folder)]
    with (folder / "log").open("wb") as log, subprocess.Popen(command, stdout=log, stderr=log) as node:
        try:
            yield
        finally:
            os.kill(node.pid, signal.SIGTERM)
            node.wait(_LIMIT_S)


def _until(operator: Client, good: Callable[[Site], bool]) -> None:
    deadline = time.monotonic() + _LIMIT_S
    while not good(site := operator.get_site(_NODE)):
        if time.monotonic() > deadline:
            raise BenchError(f"site {_NODE} is {site.state} after {_LIMIT_S:.0f} s: {site.reason}")
        time.sleep(_LOOK_S)
