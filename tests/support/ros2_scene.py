"""Robots of real ROS 2 and their services, in two networks with a bad link between; an orchestrator at the far end."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import httpx
import psutil
import yaml

from skytether.api.client import Client
from skytether.api.rest import RobotCreate, SiteCreate
from skytether.emulator.link_model import LinkConditions
from skytether.lab.embedded import EmbeddedOrchestrator
from skytether.lab.tun import SERVICE, TunEmulator

ROOT = Path(__file__).parents[2]
_FIRST_PORT = 8610
_COUNTED = re.compile(r"^skytether_topic_messages_total\{(.*)\} (\S+)$", re.MULTILINE)
_T = TypeVar("_T")


class Scene:
    """What there is; made by `scene`.

    Attributes:
        link: The two networks.
        diaries: A folder that services may write into.
    """

    def __init__(self, link: TunEmulator, orchestrator: EmbeddedOrchestrator, folder: Path) -> None:
        self.link, self.folder = link, folder
        self.diaries = folder / "diaries"
        self._orchestrator = orchestrator
        self._robots: list[Agent] = []
        self.url = orchestrator.url.replace("127.0.0.1", SERVICE)

    def ask(self, function: Callable[[Client], _T]) -> _T:
        """Ask the orchestrator as its operator."""

        def inside() -> _T:
            with Client(self.url, self._orchestrator.operator_token, insecure_http=True) as client:
                return function(client)

        return self.link.service.run(inside)

    def robot(self, name: str, service: str, **more: Any) -> Agent:
        """Register one; its agent is not started yet.

        Args:
            name: And the namespace of its topics.
            service: That it wants.
            more: Of its robot.yaml.
        """
        token = self.folder / f"{name}.token"
        token.touch(0o600)
        token.write_text(self.ask(lambda client: client.create_robot(RobotCreate(name=name)).token))
        port = _FIRST_PORT + len(self._robots)
        document = {
            "robot": name,
            "orchestrator": self.url,
            "insecure_http": True,
            "token_file": token.name,
            "service": service,
            "status_port": port,
            "safety": "none",
            "limits": {"max_gap_s": 1.0},
            "ros2": {},
            **more,
        }
        path = self.folder / f"{name}.yaml"
        path.write_text(yaml.safe_dump(document))
        self._robots.append(Agent(self, path, port))
        return self._robots[-1]

    def processes_of(self, instance: str) -> list[psutil.Process]:
        """What runs for an instance."""
        return [
            p
            for p in psutil.process_iter(["environ"])
            if instance in (p.info["environ"] or {}).get("SKYTETHER_GRANT", "")
        ]

    def close(self) -> None:
        for robot in self._robots:
            robot.close()


class Agent:
    """``skytether robot run`` in the robots' network, and what it says of itself."""

    def __init__(self, scene: Scene, path: Path, port: int) -> None:
        self._scene, self._path = scene, path
        self._log = path.with_suffix(".log")
        # One for all questions: each new one would read the certificates of the machine again.
        self._http = httpx.Client(base_url=f"http://127.0.0.1:{port}", trust_env=False)
        self.process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        command = [sys.executable, "-m", "skytether.cli", "robot", "run", str(self._path)]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        with self._log.open("ab") as log:
            self.process = self._scene.link.robot.run(
                lambda: subprocess.Popen(command, env=environment, stdout=log, stderr=log)
            )

    def kill(self) -> None:
        assert self.process is not None
        self.process.kill()
        self.process.wait()

    @property
    def log(self) -> str:
        return self._log.read_text()

    @property
    def status(self) -> dict[str, Any]:
        page = self._get("status")
        return json.loads(page) if page else {"source": None, "link": {"connected": False}, "instance": None}

    @property
    def drives(self) -> bool:
        """Whether the service does."""
        return bool(self.status["source"] == "cloud")

    @property
    def counts(self) -> dict[str, Counter[str]]:
        """Messages by topic and outcome."""
        found: dict[str, Counter[str]] = {}
        for labels, value in _COUNTED.findall(self._get("metrics")):
            label = dict(re.findall(r'(\w+)="([^"]*)"', labels))
            found.setdefault(label["topic"], Counter())[label["outcome"]] += int(float(value))
        return found

    @property
    def taken(self) -> dict[str, int]:
        """Messages that came from the robot's graph, by topic: handed to the bridge, or newer ones came before that."""
        topics = [
            t for t in self.status.get("topics", ()) if t["graph"] and t["messages"] and t["graph"]["way"] == "from"
        ]
        return {t["topic"]: t["messages"]["published"] + t["graph"]["dropped"] for t in topics}

    @property
    def told(self) -> int:
        """Velocities that were published in the robot's graph."""
        (wheels,) = [t["graph"]["passed"] for t in self.status["topics"] if t["topic"] == "cmd_vel"]
        return int(wheels)

    @property
    def settled(self) -> bool:
        """What became of every message that either end sent is known."""
        counts = self.counts
        return bool(counts) and all(
            c["sent"] == c["delivered"] + c["superseded"] + c["lost"] - c["late"] + c["unknown"]
            for c in counts.values()
        )

    def _get(self, page: str) -> str:
        def inside() -> str:
            return self._http.get(f"/{page}").text

        try:
            return self._scene.link.robot.run(inside)
        except httpx.TransportError:
            return ""

    def close(self) -> None:
        self._http.close()
        if self.process is not None and self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
            try:
                self.process.wait(30)
            finally:
                self.kill()


@contextmanager
def scene_over_a_bad_link(folder: Path, domain: int) -> Iterator[Scene]:
    """100 ms round trip, and 1 % of packets lost each way.

    Args:
        folder: For state and logs.
        domain: Of the robots' graph.
    """
    state = folder / "orchestrator"
    state.mkdir()
    environment = {"SKYTETHER_HOST": SERVICE, "SKYTETHER_INSECURE_HTTP": "true", "SKYTETHER_LOCAL_SITE": "false"}
    orchestrator = EmbeddedOrchestrator(state, environment)
    up, down = (LinkConditions(delay=0.05, loss=0.01, seed=seed) for seed in (1, 2))
    with TunEmulator(up=up, down=down) as link:
        link.service.run(orchestrator.start)
        made = Scene(link, orchestrator, folder)
        try:
            paths = [str(ROOT / part) for part in ("platform", "services", "docs/examples")]
            made.diaries.mkdir()
            made.diaries.chmod(0o777)  # a service is another user
            python = os.environ["SKYTETHER_ROS2_PYTHON"]
            options = {
                "bind_host": SERVICE,
                "python_path": paths,
                "environment": {"SKYTETHER_ROS2_PYTHON": python},
                "readable": [str(Path(python).parents[1])],
                "writable": [str(made.diaries)],
            }
            site = SiteCreate(name="edge", tier="edge", runtime="process", options=options)
            made.ask(lambda client: client.create_site(site))
            yield made
        finally:
            made.close()
            link.service.run(orchestrator.stop)
